//! What the GPU draws: against the CPU twins, against golden pictures, and properties that any picture must have.
//!
//! `RHYTID_UPDATE_GOLDENS=1 cargo test -p rhytid-tests --test pictures` draws the goldens anew. A machine without a
//! software adapter shows these tests as ignored.

mod golden;
mod morphs;
mod probe;
mod properties;
mod read_back;
mod twins;

use libtest_mimic::{Arguments, Trial};
use rhytid_client::renderer::AdapterChoice;
use rhytid_client::{CharacterAsset, Headless};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};

/// The built-in character on a software adapter; tests take turns.
pub struct Stage {
    /// The character.
    pub asset: CharacterAsset,
    /// What draws it.
    pub headless: Mutex<Headless>,
}

fn main() -> ExitCode {
    let arguments = Arguments::from_args();
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
    let stage = match Headless::on(&asset, AdapterChoice::Software) {
        Ok(headless) => Some(Arc::new(Stage { asset, headless: Mutex::new(headless) })),
        Err(error) => {
            eprintln!("ignored: {error}");
            None
        }
    };
    let mut trials = Vec::new();
    let mut add = |name: String, check: Check| {
        let on = stage.clone();
        let trial = Trial::test(name, move || match &on {
            Some(stage) => check(stage).map_err(|error| format!("{error:#}").into()),
            None => Err("there is no adapter".into()),
        });
        trials.push(trial.with_ignored_flag(stage.is_none()));
    };
    twins::add(&mut add);
    morphs::add(&mut add);
    properties::add(&mut add);
    golden::add(&mut add);
    libtest_mimic::run(&arguments, trials).exit_code()
}

/// A test's body.
pub type Check = Box<dyn Fn(&Stage) -> anyhow::Result<()> + Send>;

/// Takes a test's name and its body.
pub type Add<'a> = dyn FnMut(String, Check) + 'a;
