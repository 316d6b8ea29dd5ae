//! The folder of profiles: one JSON file a performer, read once when the service starts, written when a fit ends.

use rhytid_shared::{Profile, RoomName};
use serde::Serialize;
use std::collections::BTreeMap;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

/// Profiles in a folder: the listing is one message, and every publisher may add to it.
const MOST_PROFILES: usize = 1000;
/// Largest file: a neutral of the largest layout takes 40 KB.
const MOST_BYTES: u64 = 256 << 10;

/// Why the folder, or a profile in it, could not be had.
#[derive(Debug, thiserror::Error)]
pub enum ProfileError {
    /// The folder cannot be made or read.
    #[error("cannot use {folder} for profiles: {source}")]
    Folder {
        /// As it was named.
        folder: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot keep the profile {name}: {source}")]
    Write {
        /// The profile's name.
        name: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// There is no room for another.
    #[error("the server keeps {MOST_PROFILES} profiles already, which is its limit")]
    TooMany,
}

/// A profile as `/api/profiles` lists it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct ProfileListing {
    name: String,
    source: String,
    measured: rhytid_shared::FaceKind,
}

struct Kept {
    profile: Arc<Profile>,
    modified: SystemTime,
}

/// Profiles by name; without a folder there are none.
#[derive(Default)]
pub(crate) struct Profiles {
    folder: Option<PathBuf>,
    by_name: Mutex<BTreeMap<String, Kept>>,
}

impl Profiles {
    /// Reads a folder, which is made where there is none. What is no profile is told and left out.
    pub fn load(folder: Option<&Path>) -> Result<Self, ProfileError> {
        let Some(folder) = folder else { return Ok(Self::default()) };
        let problem = |source| ProfileError::Folder { folder: folder.display().to_string(), source };
        std::fs::create_dir_all(folder).map_err(problem)?;
        let mut by_name = BTreeMap::new();
        for entry in std::fs::read_dir(folder).map_err(problem)? {
            let path = entry.map_err(problem)?.path();
            if path.extension().is_none_or(|extension| extension != "json") {
                continue;
            }
            match read(&path) {
                Ok((name, kept)) if by_name.len() < MOST_PROFILES => {
                    by_name.insert(name, kept);
                }
                Ok(_) => tracing::warn!(path = %path.display(), "{}", ProfileError::TooMany),
                Err(problem) => tracing::warn!(path = %path.display(), problem, "left out of the profiles"),
            }
        }
        tracing::info!(folder = %folder.display(), profiles = by_name.len(), "profiles read");
        Ok(Self { folder: Some(folder.to_owned()), by_name: Mutex::new(by_name) })
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Kept>> {
        self.by_name.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The profile of this name.
    pub fn named(&self, name: &RoomName) -> Option<Arc<Profile>> {
        self.lock().get(name.as_str()).map(|kept| kept.profile.clone())
    }

    /// The newest profile that was made with this source.
    pub fn of_source(&self, source: &str) -> Option<Arc<Profile>> {
        let by_name = self.lock();
        let of_it = by_name.values().filter(|kept| !source.is_empty() && without_address(&kept.profile.source) == without_address(source));
        of_it.max_by_key(|kept| kept.modified).map(|kept| kept.profile.clone())
    }

    /// Keeps a profile by its name, in place of one of the same name; false where there is no folder, or the profile has no name.
    /// Its file is small and written whole before it takes the old one's place.
    pub fn keep(&self, profile: &Profile) -> Result<bool, ProfileError> {
        let (Some(folder), Ok(name)) = (&self.folder, RoomName::new(&profile.name)) else { return Ok(false) };
        let mut by_name = self.lock();
        if !by_name.contains_key(name.as_str()) && by_name.len() >= MOST_PROFILES {
            return Err(ProfileError::TooMany);
        }
        let problem = |source| ProfileError::Write { name: name.to_string(), source };
        let (path, fresh) = (folder.join(format!("{name}.json")), folder.join(format!("{name}.json.new")));
        let text = serde_json::to_string_pretty(profile).expect("plain data can be written");
        let mut file = std::fs::File::create(&fresh).map_err(problem)?;
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(problem)?;
        std::fs::rename(&fresh, &path).map_err(problem)?;
        by_name.insert(name.to_string(), Kept { profile: Arc::new(profile.clone()), modified: SystemTime::now() });
        Ok(true)
    }

    /// All of them, by name.
    pub fn list(&self) -> Vec<ProfileListing> {
        let listing = |Kept { profile, .. }: &Kept| ProfileListing {
            name: profile.name.clone(),
            source: profile.source.clone(),
            measured: profile.measured,
        };
        self.lock().values().map(listing).collect()
    }
}

/// What a tracker is called, without the address it sends from, which a phone gets anew every day.
fn without_address(source: &str) -> &str {
    let address = source.strip_suffix(')').and_then(|source| source.rsplit_once(" ("));
    address.filter(|(_, address)| address.parse::<std::net::IpAddr>().is_ok()).map_or(source, |(name, _)| name)
}

/// Reads a profile's file, which gives it its name. The error says what is wrong.
fn read(path: &Path) -> Result<(String, Kept), String> {
    let name = path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| RoomName::new(stem).ok());
    let name = name.ok_or("its name is none that a profile can have")?;
    let about = std::fs::metadata(path).map_err(|error| error.to_string())?;
    if about.len() > MOST_BYTES {
        return Err(std::io::Error::new(ErrorKind::FileTooLarge, format!("larger than {MOST_BYTES} bytes")).to_string());
    }
    let text = std::fs::read_to_string(path).map_err(|error| error.to_string())?;
    let profile = Profile { name: name.to_string(), ..Profile::from_json(&text).map_err(|error| error.message)? };
    Ok((name.to_string(), Kept { profile: Arc::new(profile), modified: about.modified().unwrap_or(SystemTime::UNIX_EPOCH) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_outlive_the_service_and_what_is_none_is_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let profiles = Profiles::load(Some(&folder.path().join("made"))).unwrap();
        let profile = |name: &str, smile: f32| {
            Profile::from_json(&format!(
                r#"{{"rhytid_profile":1,"name":"{name}","source":"{name}'s phone","measured":"weights","ranges":{{"smile":{smile}}}}}"#
            ))
            .unwrap()
        };
        assert!(profiles.keep(&profile("ada", 1.5)).unwrap());
        assert!(profiles.keep(&profile("ben", 2.0)).unwrap());
        assert!(profiles.keep(&profile("ada", 1.25)).unwrap());
        assert!(!profiles.keep(&profile("", 1.0)).unwrap(), "without a name it is kept by nobody");
        std::fs::write(folder.path().join("made/broken.json"), "{").unwrap();
        std::fs::write(folder.path().join("made/no name.json"), "{}").unwrap();
        let again = Profiles::load(Some(&folder.path().join("made"))).unwrap();
        assert_eq!(again.list().iter().map(|listed| listed.name.as_str()).collect::<Vec<_>>(), ["ada", "ben"]);
        assert_eq!(again.of_source("ada's phone").unwrap().ranges.smile, 1.25);
        assert_eq!(again.of_source("ada's phone (192.0.2.7)").unwrap().name, "ada", "at another address");
        assert!(again.of_source("ada's phone (old)").is_none());
        assert!(again.of_source("").is_none() && again.of_source("other").is_none());
        assert_eq!(again.named(&RoomName::new("ben").unwrap()).unwrap().ranges.smile, 2.0);
    }

    #[test]
    fn a_folder_that_cannot_be_is_said() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let error = Profiles::load(Some(file.path())).map(|_| ()).unwrap_err().to_string();
        assert!(error.starts_with("cannot use ") && error.contains("for profiles"), "{error}");
        assert!(
            !Profiles::load(None)
                .unwrap()
                .keep(&Profile::from_json(r#"{"rhytid_profile":1,"name":"a","measured":"weights"}"#).unwrap())
                .unwrap()
        );
    }
}
