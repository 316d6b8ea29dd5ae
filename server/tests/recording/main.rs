//! Facts about recordings: they verify, they survive what kills their writer, they are small, they can be entered anywhere, and no
//! bytes break their reader.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod fixture;
mod gltf;
#[path = "../process/http.rs"]
mod http;
mod player;
#[path = "../process/mod.rs"]
mod process;
mod reader;
mod server;
#[path = "../process/signal.rs"]
mod signal;
#[path = "../process/socket.rs"]
mod socket;
mod solved_again;
mod writer;
