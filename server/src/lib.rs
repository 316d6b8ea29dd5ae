//! Takes what trackers see, moves a character's bones with it and streams the solved frames to viewers.
//!
//! `solve` and `pipeline` are pure: frames in, packets out. Everything else is the service around them: [`run`] serves,
//! [`send()`] publishes feed files, `recording` keeps rooms in files, `load` measures the whole.

#![forbid(unsafe_code)]

mod answer;
mod clip;
mod cluster;
mod config;
mod control;
pub mod feed;
mod fit;
mod framed;
#[doc(hidden)]
pub mod fuzz;
mod http;
#[cfg(target_os = "linux")]
pub mod load;
mod lock;
mod metrics;
mod page;
pub mod pipeline;
mod profiles;
mod publish;
pub mod recording;
mod room;
mod send;
mod service;
mod socket;
pub mod solve;
mod source;
mod stream;
mod tls;
mod token;
pub mod trackers;
mod viewer;

pub use clip::{Clip, ClipError, ClipReader};
pub use cluster::{ClusterConfig, ClusterError};
pub use config::{Access, Limits, ServerConfig, ServerConfigError, Timeouts, Tls};
pub use fit::{FitCliError, Guide, LiveFit, StepAt, fit_feed, fit_live, write_profile};
pub use profiles::ProfileError;
pub use send::{SendError, SendOptions, SendReport, SendSource, send};
pub use service::{Play, ServerError, bind, load_character, run};
pub use tls::{Identity, TlsError};
pub use token::{Claims, Role, TokenError, make_key_file, make_token};
pub use trackers::fake::{FakeError, FakeKind, FakeOptions, fake};
pub use trackers::spec::{ListenSpec, RoomRule, SpecError, VmcOutSpec};
