//! Who may do what: tokens (JSON Web Tokens, HS256) and the keys that sign them.
//!
//! A token names a role, rooms and an end. The algorithm is pinned, whatever a token's head says; the end is required. Keys
//! stand in a file, one a line: the first signs, all of them are accepted, and the file is read again when it changes. So a
//! key is replaced by putting a new one on top, and everything an old key has signed is revoked by taking its line away.

use crate::config::ServerConfigError;
use jsonwebtoken::crypto::{CryptoProvider, JwtSigner, JwtVerifier, KeyUtils};
use jsonwebtoken::errors::{ErrorKind, new_error};
use jsonwebtoken::signature::{Error as SignatureError, Signer, Verifier};
use jsonwebtoken::{Algorithm, DecodingKey, EncodingKey, Header, Validation, decode, encode};
use rhytid_shared::RoomName;
use ring::hmac;
use ring::rand::{SecureRandom, SystemRandom};
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Once, PoisonError, RwLock};
use std::time::{Duration, SystemTime};

/// Bytes of a key: as many as HMAC-SHA-256 has of output (RFC 7518, 3.2).
const KEY_BYTES: usize = 32;
/// Keys in a file: the present one, and a few that are on their way out.
const MOST_KEYS: usize = 16;
/// Longest token, bytes; one for twenty rooms takes 500.
const MOST_TOKEN_BYTES: usize = 4096;
/// What clocks may differ by, seconds.
const LEEWAY_SECONDS: u64 = 5;
/// Longest life of a token, seconds.
const MOST_SECONDS: u64 = 366 * 86_400;

/// Why there is no key or no token.
#[derive(Debug, thiserror::Error)]
pub enum TokenError {
    /// A file of keys could not be read or made.
    #[error("key file {path}: {problem}")]
    File {
        /// The file as it was named.
        path: String,
        /// What is wrong with it.
        problem: String,
    },
    /// What was asked for makes no sense.
    #[error("{0}")]
    Request(String),
}

/// What a token lets its bearer do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Watch its rooms.
    View,
    /// Publish to its rooms, and watch them.
    Publish,
    /// Everything in its rooms; list rooms and read metrics.
    Admin,
}

impl Role {
    /// True where a bearer of this role may do what `needed` may.
    fn covers(self, needed: Self) -> bool {
        self as u8 >= needed as u8
    }
}

/// What stands in a token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Claims {
    /// What for.
    pub role: Role,
    /// Where: names of rooms, or `*` for all.
    pub rooms: Vec<String>,
    /// Its end, seconds since 1970.
    pub exp: u64,
    /// When it was made, seconds since 1970.
    #[serde(default)]
    pub iat: u64,
}

/// Why a token does not do. Says nothing about keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// There is none.
    Missing,
    /// Not signed by a key that is known, or no token at all.
    Bad,
    /// Its time is over.
    Expired,
    /// It came in the clear from another machine.
    InTheClear,
    /// It is for something else.
    Role,
    /// It is for other rooms.
    Room,
}

impl Refusal {
    /// Short and stable, and for people.
    pub fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Missing => ("token_missing", "a token is needed here: header Authorization: Bearer …, or subprotocol rhytid.token.…"),
            Self::Bad => ("token_bad", "the token is none of this server's"),
            Self::Expired => ("token_expired", "the token's time is over"),
            Self::InTheClear => ("token_in_the_clear", "a token must come over TLS (https, wss), except from the same machine"),
            Self::Role => ("token_role", "the token's role does not allow this"),
            Self::Room => ("token_room", "the token is for other rooms"),
        }
    }
}

impl Claims {
    /// Checks that the bearer may act as `role`, in `room` where it is about one. Until when, seconds since 1970.
    pub(crate) fn allow(&self, role: Role, room: Option<&RoomName>) -> Result<u64, Refusal> {
        if !self.role.covers(role) {
            return Err(Refusal::Role);
        }
        match room {
            Some(room) if !self.rooms.iter().any(|name| name == "*" || name == room.as_str()) => Err(Refusal::Room),
            // What is about all rooms is for those who may do it in all of them.
            None if !self.rooms.iter().any(|name| name == "*") => Err(Refusal::Room),
            _ => Ok(self.exp),
        }
    }
}

/// The keys of a server.
pub(crate) struct Keys {
    path: PathBuf,
    seen: Option<(SystemTime, u64)>,
    current: Arc<RwLock<Arc<Vec<DecodingKey>>>>,
}

/// What a token is checked with.
#[derive(Clone)]
pub(crate) struct Checker(Arc<RwLock<Arc<Vec<DecodingKey>>>>);

impl Keys {
    pub fn load(path: &Path) -> Result<Self, TokenError> {
        install_crypto();
        let seen = look(path);
        let keys = read_keys(path)?;
        let keys = keys.iter().map(|key| DecodingKey::from_secret(key)).collect();
        Ok(Self { path: path.to_owned(), seen, current: Arc::new(RwLock::new(Arc::new(keys))) })
    }

    pub fn checker(&self) -> Checker {
        Checker(self.current.clone())
    }

    /// Reads the file again where it has changed; keeps what it has where that does not work.
    pub fn reload(&mut self) {
        let seen = look(&self.path);
        if seen == self.seen {
            return;
        }
        self.seen = seen;
        match read_keys(&self.path) {
            Ok(keys) => {
                let keys: Vec<DecodingKey> = keys.iter().map(|key| DecodingKey::from_secret(key)).collect();
                tracing::info!(keys = keys.len(), "read the token keys again");
                *self.current.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(keys);
            }
            Err(error) => tracing::error!(%error, "the token keys stay as they were"),
        }
    }
}

impl Checker {
    /// One with a key that nobody can have.
    pub(crate) fn with_unknown_key() -> Self {
        install_crypto();
        let mut key = [0; KEY_BYTES];
        SystemRandom::new().fill(&mut key).expect("the system has random numbers");
        Self(Arc::new(RwLock::new(Arc::new(vec![DecodingKey::from_secret(&key)]))))
    }

    /// What `token` says, where a key has signed it and its time is not over, nor further away than that of any token made here.
    pub fn check(&self, token: &str) -> Result<Claims, Refusal> {
        if token.len() > MOST_TOKEN_BYTES {
            return Err(Refusal::Bad);
        }
        let mut validation = Validation::new(Algorithm::HS256);
        validation.leeway = LEEWAY_SECONDS;
        validation.validate_nbf = true;
        let keys = self.0.read().unwrap_or_else(PoisonError::into_inner).clone();
        let mut refusal = Refusal::Bad;
        for key in keys.iter() {
            match decode::<Claims>(token, key, &validation) {
                // One that nobody here can have made; and times so far away cannot be reckoned with.
                Ok(data) if data.claims.exp > now_seconds().saturating_add(MOST_SECONDS + LEEWAY_SECONDS) => return Err(Refusal::Bad),
                Ok(data) => return Ok(data.claims),
                // Looked at after the signature.
                Err(error) if matches!(error.kind(), ErrorKind::ExpiredSignature) => refusal = Refusal::Expired,
                Err(_) => {}
            }
        }
        Err(refusal)
    }
}

fn look(path: &Path) -> Option<(SystemTime, u64)> {
    let about = std::fs::metadata(path).ok()?;
    Some((about.modified().ok()?, about.len()))
}

fn read_keys(path: &Path) -> Result<Vec<[u8; KEY_BYTES]>, TokenError> {
    let refuse = |problem: String| TokenError::File { path: path.display().to_string(), problem };
    let about = std::fs::metadata(path).map_err(|error| refuse(error.to_string()))?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        if about.permissions().mode() & 0o022 != 0 {
            return Err(refuse("others may write it: chmod 600".into()));
        }
        if about.permissions().mode() & 0o044 != 0 {
            tracing::warn!(path = %path.display(), "others on this machine may read the key file: chmod 600");
        }
    }
    if about.len() > 4096 {
        return Err(refuse(format!("it has {} bytes, expected {MOST_KEYS} lines of a key each at most", about.len())));
    }
    let text = std::fs::read_to_string(path).map_err(|error| refuse(error.to_string()))?;
    let lines = text.lines().map(str::trim).enumerate().filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let keys: Vec<_> = lines
        .map(|(at, line)| {
            from_hex(line).ok_or_else(|| refuse(format!("line {} is no key, expected {} hexadecimal digits", at + 1, 2 * KEY_BYTES)))
        })
        .collect::<Result<_, _>>()?;
    match keys.len() {
        0 => Err(refuse("it holds no key".into())),
        1..=MOST_KEYS => Ok(keys),
        count => Err(refuse(format!("it holds {count} keys, expected {MOST_KEYS} at most"))),
    }
}

fn from_hex(text: &str) -> Option<[u8; KEY_BYTES]> {
    let mut key = [0; KEY_BYTES];
    if text.len() != 2 * KEY_BYTES || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    for (byte, at) in key.iter_mut().zip((0..).step_by(2)) {
        *byte = u8::from_str_radix(&text[at..at + 2], 16).ok()?;
    }
    Some(key)
}

/// Makes a file with a new key, which only its owner may read; never replaces one that is there.
pub fn make_key_file(path: &Path) -> Result<(), TokenError> {
    let refuse = |problem: String| TokenError::File { path: path.display().to_string(), problem };
    let mut key = [0; KEY_BYTES];
    SystemRandom::new().fill(&mut key).map_err(|_| refuse("the system has no random numbers".into()))?;
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(path).map_err(|error| refuse(error.to_string()))?;
    let text: String = key.iter().map(|byte| format!("{byte:02x}")).collect();
    writeln!(file, "{text}").and_then(|()| file.sync_all()).map_err(|error| refuse(error.to_string()))
}

/// Makes a token that holds for `time` from now, signed with the first key of a file.
pub fn make_token(key_file: &Path, role: Role, rooms: &[String], time: Duration) -> Result<String, TokenError> {
    install_crypto();
    if time.is_zero() || time.as_secs() > MOST_SECONDS {
        return Err(TokenError::Request("a token holds for a second at least and 366 days at most".into()));
    }
    if rooms.is_empty() {
        return Err(TokenError::Request("a token needs a room, or * for all of them".into()));
    }
    if let Some(error) = rooms.iter().filter(|room| *room != "*").find_map(|room| RoomName::new(room).err()) {
        return Err(TokenError::Request(error.to_string()));
    }
    let keys = read_keys(key_file)?;
    let now = now_seconds();
    let claims = Claims { role, rooms: rooms.to_vec(), exp: now + time.as_secs().max(1), iat: now };
    encode(&Header::new(Algorithm::HS256), &claims, &EncodingKey::from_secret(&keys[0]))
        .map_err(|error| TokenError::Request(format!("cannot make a token: {error}")))
}

/// Seconds since 1970.
pub(crate) fn now_seconds() -> u64 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// A server that others can reach must know who may do what, or be told that it need not.
pub(crate) fn demand(key: Option<&Path>, is_insecure: bool, listens_on_loopback: bool) -> Result<Option<Keys>, ServerConfigError> {
    match key {
        Some(path) => Ok(Some(Keys::load(path)?)),
        None if listens_on_loopback || is_insecure => Ok(None),
        None => Err(ServerConfigError::Open),
    }
}

/// `ring`, which is here for TLS already, signs and verifies; and it knows one algorithm, so no token can choose another.
fn install_crypto() {
    static PROVIDER: CryptoProvider = CryptoProvider {
        signer_factory: |algorithm, key| match algorithm {
            Algorithm::HS256 => Ok(Box::new(Hs256(hmac::Key::new(hmac::HMAC_SHA256, key.as_bytes())))),
            _ => Err(new_error(ErrorKind::InvalidAlgorithm)),
        },
        verifier_factory: |algorithm, key| match algorithm {
            Algorithm::HS256 => Ok(Box::new(Hs256(hmac::Key::new(hmac::HMAC_SHA256, key.try_get_as_bytes()?)))),
            _ => Err(new_error(ErrorKind::InvalidAlgorithm)),
        },
        key_utils: KeyUtils::new_unimplemented(),
    };
    static INSTALL: Once = Once::new();
    INSTALL.call_once(|| {
        // Whoever installed another one before uses this crate for something else, and HS256 means the same there.
        let _ = PROVIDER.install_default();
    });
}

struct Hs256(hmac::Key);

impl Signer<Vec<u8>> for Hs256 {
    fn try_sign(&self, message: &[u8]) -> Result<Vec<u8>, SignatureError> {
        Ok(hmac::sign(&self.0, message).as_ref().to_vec())
    }
}

impl JwtSigner for Hs256 {
    fn algorithm(&self) -> Algorithm {
        Algorithm::HS256
    }
}

impl Verifier<Vec<u8>> for Hs256 {
    fn verify(&self, message: &[u8], signature: &Vec<u8>) -> Result<(), SignatureError> {
        // In constant time.
        hmac::verify(&self.0, message, signature).map_err(|_| SignatureError::new())
    }
}

impl JwtVerifier for Hs256 {
    fn algorithm(&self) -> Algorithm {
        Algorithm::HS256
    }
}

/// 128 random bits as text, for what nobody shall guess.
pub(crate) fn random_key() -> Arc<str> {
    let mut key = [0; 16];
    SystemRandom::new().fill(&mut key).expect("the system has random numbers");
    format!("{:032x}", u128::from_le_bytes(key)).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Scratch(PathBuf);

    impl Scratch {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("rhytid-token-{}-{name}", std::process::id()));
            let _ = std::fs::remove_file(&path);
            Self(path)
        }
    }

    impl Drop for Scratch {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.0);
        }
    }

    fn room(name: &str) -> RoomName {
        RoomName::new(name).unwrap()
    }

    fn signed(key: &Path, header: &Header, claims: &impl Serialize) -> String {
        install_crypto();
        encode(header, claims, &EncodingKey::from_secret(&read_keys(key).unwrap()[0])).unwrap()
    }

    const HOUR: Duration = Duration::from_secs(3600);

    #[test]
    fn token_does_what_it_says_and_nothing_else() {
        let file = Scratch::new("roles");
        make_key_file(&file.0).unwrap();
        let checker = Keys::load(&file.0).unwrap().checker();
        let check = |role, rooms: &[&str]| {
            let rooms: Vec<String> = rooms.iter().map(|room| (*room).to_owned()).collect();
            checker.check(&make_token(&file.0, role, &rooms, HOUR).unwrap()).unwrap()
        };
        let view = check(Role::View, &["a", "b"]);
        assert!(view.allow(Role::View, Some(&room("b"))).is_ok());
        assert_eq!(view.allow(Role::View, Some(&room("c"))), Err(Refusal::Room));
        assert_eq!(view.allow(Role::Publish, Some(&room("a"))), Err(Refusal::Role));
        assert_eq!(view.allow(Role::Admin, None), Err(Refusal::Role));
        let publish = check(Role::Publish, &["a"]);
        assert!(publish.allow(Role::Publish, Some(&room("a"))).is_ok() && publish.allow(Role::View, Some(&room("a"))).is_ok());
        assert_eq!(publish.allow(Role::Publish, Some(&room("A"))), Err(Refusal::Room), "names are exact");
        let admin = check(Role::Admin, &["*"]);
        assert!(admin.allow(Role::Admin, None).is_ok() && admin.allow(Role::Publish, Some(&room("z"))).is_ok());
        assert_eq!(check(Role::Admin, &["a"]).allow(Role::Admin, None), Err(Refusal::Room), "one room's admin lists no others");
    }

    #[test]
    fn forged_unending_and_expired_tokens_are_refused() {
        let (file, other) = (Scratch::new("forged"), Scratch::new("other"));
        make_key_file(&file.0).unwrap();
        make_key_file(&other.0).unwrap();
        let checker = Keys::load(&file.0).unwrap().checker();
        let good = make_token(&file.0, Role::View, &["a".into()], HOUR).unwrap();
        checker.check(&good).unwrap();
        assert_eq!(checker.check(&make_token(&other.0, Role::View, &["a".into()], HOUR).unwrap()), Err(Refusal::Bad));
        // Another algorithm, none at all, and no signature.
        let [_, claims, signature] = good.split('.').collect::<Vec<_>>()[..] else { panic!("three parts") };
        for head in ["eyJhbGciOiJub25lIn0", "eyJhbGciOiJIUzM4NCJ9", "eyJhbGciOiJSUzI1NiJ9"] {
            assert_eq!(checker.check(&format!("{head}.{claims}.{signature}")), Err(Refusal::Bad), "{head}");
            assert_eq!(checker.check(&format!("{head}.{claims}.")), Err(Refusal::Bad), "{head}");
        }
        for wrong in ["", ".", "..", "a.b.c", &good[1..], &good[..good.len() - 1], &"a".repeat(100_000)] {
            assert_eq!(checker.check(wrong), Err(Refusal::Bad));
        }
        let head = Header::new(Algorithm::HS256);
        let now = now_seconds();
        let unending = signed(&file.0, &head, &serde_json::json!({"role": "admin", "rooms": ["*"]}));
        assert_eq!(checker.check(&unending), Err(Refusal::Bad), "an end is required");
        let says = |exp: u64| signed(&file.0, &head, &Claims { role: Role::Admin, rooms: vec!["*".into()], exp, iat: 0 });
        assert_eq!(checker.check(&says(now - 60)), Err(Refusal::Expired));
        assert!(checker.check(&says(now - 2)).is_ok(), "clocks differ a little");
        assert!(checker.check(&says(now + MOST_SECONDS)).is_ok());
        for end in [now + MOST_SECONDS + 60, u64::MAX / 2, u64::MAX] {
            assert_eq!(checker.check(&says(end)), Err(Refusal::Bad), "longer than any token holds: {end}");
        }
        let later = serde_json::json!({"role": "view", "rooms": ["a"], "exp": now + 100, "nbf": now + 50});
        assert_eq!(checker.check(&signed(&file.0, &head, &later)), Err(Refusal::Bad), "not yet");
    }

    #[test]
    fn keys_are_replaced_and_taken_away_while_the_server_runs() {
        let (file, old) = (Scratch::new("rotation"), Scratch::new("rotation-old"));
        make_key_file(&old.0).unwrap();
        make_key_file(&file.0).unwrap();
        let [new_key, old_key] = [&file, &old].map(|file| std::fs::read_to_string(&file.0).unwrap());
        let by_old = make_token(&old.0, Role::View, &["a".into()], HOUR).unwrap();
        let mut keys = Keys::load(&old.0).unwrap();
        let checker = keys.checker();
        std::fs::write(&old.0, format!("# new first\n{new_key}\n{old_key}")).unwrap();
        keys.reload();
        let by_new = make_token(&file.0, Role::View, &["a".into()], HOUR).unwrap();
        assert!(checker.check(&by_old).is_ok() && checker.check(&by_new).is_ok());
        std::fs::write(&old.0, "not a key").unwrap();
        keys.reload();
        assert!(checker.check(&by_old).is_ok(), "a broken file changes nothing");
        std::fs::write(&old.0, &new_key).unwrap();
        keys.reload();
        assert_eq!(checker.check(&by_old), Err(Refusal::Bad));
        assert!(checker.check(&by_new).is_ok());
    }

    #[test]
    fn key_files_are_private_and_never_replaced() {
        let file = Scratch::new("private");
        make_key_file(&file.0).unwrap();
        assert!(make_key_file(&file.0).is_err());
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(std::fs::metadata(&file.0).unwrap().permissions().mode() & 0o777, 0o600);
            std::fs::set_permissions(&file.0, std::fs::Permissions::from_mode(0o622)).unwrap();
            assert!(read_keys(&file.0).unwrap_err().to_string().contains("others may write it"));
        }
        assert!(make_token(Path::new("no/such"), Role::View, &["a".into()], HOUR).unwrap_err().to_string().contains("no/such"));
        for rooms in [vec![], vec!["a b".to_owned()]] {
            assert!(matches!(make_token(&file.0, Role::View, &rooms, HOUR), Err(TokenError::Request(_))));
        }
    }
}
