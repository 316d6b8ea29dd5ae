//! Files of recordings: their names, and who may write one.

use super::recorder::RecordError;
use rhytid_shared::RoomName;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Makes a file of its own for a recording of `room`: no other one is overwritten. A room's name cannot leave the folder: it has no
/// dots and no slashes.
pub(super) fn create(dir: &Path, room: &RoomName) -> Result<(File, PathBuf), RecordError> {
    let time = stamp(SystemTime::now());
    for attempt in 1..100 {
        let suffix = if attempt == 1 { String::new() } else { format!("-{attempt}") };
        let name = format!("{room}-{time}{suffix}.mcap");
        let path = dir.join(&name);
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => {
                hold(&file);
                return Ok((file, path));
            }
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(source) => return Err(RecordError::Create { file: name, source }),
        }
    }
    let source = io::ErrorKind::AlreadyExists.into();
    Err(RecordError::Create { file: format!("{room}-{time}.mcap"), source })
}

/// Marks a recording's file as its holder's for as long as it is open there, also in clones of it; false where another holds it.
/// Whoever only reads is not hindered: elsewhere than on Unix a mark would do that, so there is none.
pub(super) fn hold(file: &File) -> bool {
    #[cfg(unix)]
    return !matches!(file.try_lock(), Err(std::fs::TryLockError::WouldBlock));
    #[cfg(not(unix))]
    {
        let _ = file;
        true
    }
}

/// The room that the name of a recording says, where it is one that [`create`] gives.
pub(crate) fn room_of_file(name: &str) -> Option<RoomName> {
    let name = name.strip_suffix(".mcap")?;
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let name = name.rsplit_once('-').filter(|(_, number)| is_number(number)).map_or(name, |(name, _)| name);
    let (room, stamp) = name.rsplit_once('-')?;
    let is_stamp = stamp.len() == "20260131T235959Z".len()
        && stamp.bytes().enumerate().all(|(at, byte)| match at {
            8 => byte == b'T',
            15 => byte == b'Z',
            _ => byte.is_ascii_digit(),
        });
    if is_stamp { RoomName::new(room).ok() } else { None }
}

/// `20260131T235959Z`.
fn stamp(time: SystemTime) -> String {
    let seconds = time.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Days since 1970 to a date of the Gregorian calendar, counted in years that begin in March ("civil from days", Hinnant 2013).
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month + 2) / 5 + 1;
    let month = if month < 10 { month + 3 } else { month - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year:04}{month:02}{day:02}T{:02}{:02}{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn recordings_are_told_by_room_though_names_begin_alike() {
        let room = |file: &str| room_of_file(file).map(|room| room.to_string());
        assert_eq!(room("a-20260131T235959Z.mcap").as_deref(), Some("a"));
        assert_eq!(room("a-20260131T235959Z-12.mcap").as_deref(), Some("a"));
        assert_eq!(room("a-b-20260131T235959Z.mcap").as_deref(), Some("a-b"));
        assert_eq!(room("a-20260131T235959Z-20260131T235959Z.mcap").as_deref(), Some("a-20260131T235959Z"));
        for file in ["a-.mcap", "a-20260131T235959Z-.mcap", "b.mcap", "-20260131T235959Z.mcap", "a-20260131T235959Z", "a-2.mcap"] {
            assert_eq!(room(file), None, "{file}");
        }
    }

    #[test]
    fn stamps_are_dates() {
        let at = |seconds: u64| stamp(UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(0), "19700101T000000Z");
        assert_eq!(at(951_827_696), "20000229T123456Z");
        assert_eq!(at(1_767_225_599), "20251231T235959Z");
    }
}
