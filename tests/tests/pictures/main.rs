//! What the GPU draws: against the CPU twins, against golden pictures, and properties that any picture must have.
//!
//! `RHYTID_UPDATE_GOLDENS=1 cargo test -p rhytid-tests --test pictures` draws the goldens anew. A machine without a
//! software adapter shows these tests as ignored.

mod blood;
mod golden;
mod morphs;
mod probe;
mod properties;
mod read_back;
mod sharing;
mod skin;
mod twins;
mod views;
mod zones;

use libtest_mimic::{Arguments, Trial};
use rhytid_client::renderer::AdapterChoice;
use rhytid_client::{CharacterAsset, Headless, RenderError};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use std::process::ExitCode;
use std::sync::{Arc, Mutex, MutexGuard};

/// The built-in character on a software adapter; tests take turns.
pub struct Stage {
    /// The character.
    pub asset: CharacterAsset,
    /// What draws it.
    headless: Mutex<Headless>,
}

impl Stage {
    fn new(asset: CharacterAsset) -> Result<Self, RenderError> {
        let headless = Mutex::new(Headless::on(&asset, AdapterChoice::Software)?);
        Ok(Self { asset, headless })
    }

    /// The same character with a change, on a device of its own.
    pub fn variant(&self, change: impl FnOnce(&mut CharacterAsset)) -> anyhow::Result<Self> {
        let mut asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
        change(&mut asset);
        Ok(Self::new(asset)?)
    }

    /// The renderer, when its turn comes.
    pub fn headless(&self) -> anyhow::Result<MutexGuard<'_, Headless>> {
        self.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))
    }
}

fn main() -> ExitCode {
    let arguments = Arguments::from_args();
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
    let stage = match Stage::new(asset) {
        Ok(stage) => Some(Arc::new(stage)),
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
    skin::add(&mut add);
    blood::add(&mut add);
    zones::add(&mut add);
    sharing::add(&mut add);
    views::add(&mut add);
    properties::add(&mut add);
    golden::add(&mut add);
    libtest_mimic::run(&arguments, trials).exit_code()
}

/// A test's body.
pub type Check = Box<dyn Fn(&Stage) -> anyhow::Result<()> + Send>;

/// Takes a test's name and its body.
pub type Add<'a> = dyn FnMut(String, Check) + 'a;
