//! Recordings: what a room's publishers sent, what the server made of it, and the packets that went out, in one MCAP file that can
//! be played, solved again and compared.
//!
//! `format` says what stands in a file, `writer` writes it beside the live stream and never holds it up, `reader` reads any bytes
//! that claim to be one. The rest works on files: `verify`, `recover`, `player`, `export`.

mod format;
mod reader;
pub(crate) mod text;
mod verify;
mod writer;

pub use format::{Entry, SessionEvent, Topic};
pub use reader::{ReadError, Recording};
pub use verify::{Difference, VerifyError, VerifyReport, verify};
pub(crate) use writer::{Item, RecordError, Recorder, RecorderStatus, Sink};
pub use writer::{RecordConfig, RecordingWriter};
