//! Recordings: what a room's publishers sent, what the server made of it, and the packets that went out, in one MCAP file that can
//! be played, solved again and compared.
//!
//! `format` says what stands in a file, `recorder` makes one beside the live stream and never holds it up, `viewer` from another
//! machine, `writer` writes for both; `reader` reads any bytes that claim to be one by what `record` finds in them, `faces` and `feed`
//! what is in it. The rest works on files: `verify`, `recover`, `player`, `export`.

mod export;
mod faces;
mod feed;
mod files;
mod format;
pub(crate) mod fuzz;
mod player;
mod reader;
mod record;
mod recorder;
mod recover;
pub(crate) mod text;
mod verify;
mod viewer;
mod writer;

pub use export::{ExportError, export_csv, export_gltf};
pub use faces::{Faces, Moment};
pub use feed::{RecordedFeed, RecordedSession};
pub(crate) use files::room_of_file;
pub use format::{Entry, SessionEvent, Topic};
pub(crate) use player::Players;
pub use player::{PlayError, PlayRequest, PlayStatus};
pub use reader::{ChunkPlace, ReadError, Recording};
pub(crate) use recorder::{Item, Made, Recorder, RecorderStatus, Sink};
pub use recorder::{RecordConfig, RecordError};
pub use recover::{RecoverError, RecoverReport, recover};
pub use verify::{Difference, VerifyError, VerifyReport, verify};
pub use viewer::{WatchError, watch};
pub use writer::RecordingWriter;
