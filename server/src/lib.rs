//! Takes what trackers see, moves a character's bones with it and streams the solved frames to viewers.
//!
//! `solve` and `pipeline` are pure: frames in, packets out. Everything else is the service around them: [`run`] serves,
//! [`send()`] publishes feed files, `load` measures the whole.

#![forbid(unsafe_code)]

mod clip;
mod config;
pub mod feed;
mod http;
#[cfg(target_os = "linux")]
pub mod load;
mod metrics;
pub mod pipeline;
mod publish;
mod room;
mod send;
mod service;
mod socket;
pub mod solve;
mod stream;
mod tls;
mod token;
mod viewer;

pub use clip::{Clip, ClipError, ClipReader};
pub use config::{Access, Limits, ServerConfig, ServerConfigError, Timeouts, Tls};
pub use send::{SendError, SendOptions, SendReport, SendSource, send};
pub use service::{ServerError, bind, load_character, run};
pub use tls::{Identity, TlsError};
pub use token::{Claims, Role, TokenError, make_key_file, make_token};
