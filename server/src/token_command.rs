//! `token`: makes tokens and the keys that sign them.

use anyhow::Context;
use clap::Args;
use rhytid_server::{Role, make_key_file, make_token};
use std::io::Read;
use std::path::PathBuf;
use std::time::Duration;

/// Longest file of a token.
const MOST_TOKEN_BYTES: u64 = 4096;

#[derive(Args)]
pub(crate) struct TokenArgs {
    /// Make this file with a new key in it, readable by its owner only.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["key", "role", "rooms"])]
    new_key: Option<PathBuf>,
    /// Sign with the first key of this file.
    #[arg(long, value_name = "FILE", required_unless_present = "new_key", requires = "role", requires = "rooms")]
    key: Option<PathBuf>,
    /// What for: view rooms, publish to them (and view them), or everything.
    #[arg(long, value_enum)]
    role: Option<Role>,
    /// A room, or * for all (repeat for several).
    #[arg(long = "room", value_name = "NAME")]
    rooms: Vec<String>,
    /// How long it holds: a number with s, m, h or d behind it.
    #[arg(long = "for", default_value = "8h", value_name = "TIME", value_parser = parse_time)]
    time: Duration,
}

fn parse_time(text: &str) -> Result<Duration, String> {
    let expected = || "expected a number with s, m, h or d behind it, e.g. 8h".to_owned();
    let unit = text.chars().last().ok_or_else(expected)?;
    let seconds = match unit {
        's' => 1,
        'm' => 60,
        'h' => 3600,
        'd' => 86_400,
        _ => return Err(expected()),
    };
    let count: u64 = text[..text.len() - 1].parse().map_err(|_| expected())?;
    count.checked_mul(seconds).map(Duration::from_secs).ok_or_else(expected)
}

/// Makes what `args` ask for; a token goes to standard output.
pub(crate) fn token(args: &TokenArgs) -> anyhow::Result<()> {
    if let Some(path) = &args.new_key {
        make_key_file(path)?;
        eprintln!("made a key in {}; who can read it can make tokens", path.display());
        return Ok(());
    }
    let key = args.key.as_ref().context("expected --key or --new-key")?;
    let role = args.role.context("expected --role")?;
    println!("{}", make_token(key, role, &args.rooms, args.time)?);
    Ok(())
}

/// How a command that goes to a server is given its token.
#[derive(Args)]
pub(crate) struct GivenToken {
    /// What lets it in, where the server wants to know; else from the environment's RHYTID_TOKEN. Others on this machine can read
    /// the arguments of a command: rather use a file.
    #[arg(long, value_name = "TOKEN", conflicts_with = "token_file")]
    token: Option<String>,
    /// A file with the token.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

impl GivenToken {
    /// The token, if there is one: given by itself, in a file, or in the environment.
    pub(crate) fn read(self) -> anyhow::Result<Option<String>> {
        let token = match &self.token_file {
            Some(path) => {
                let reading = || format!("cannot read token {}", path.display());
                let mut text = String::new();
                let file = std::fs::File::open(path).with_context(reading)?;
                file.take(MOST_TOKEN_BYTES).read_to_string(&mut text).with_context(reading)?;
                Some(text)
            }
            None => self.token.or_else(|| std::env::var("RHYTID_TOKEN").ok()),
        };
        Ok(token.map(|token| token.trim().to_owned()).filter(|token| !token.is_empty()))
    }
}
