//! The service over real sockets: a server in this process, blocking clients in threads.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod service {
    pub mod bad_input;
    pub mod expressions;
    pub mod fitting;
    pub mod harness;
    pub mod http;
    pub mod neutral;
    pub mod rooms;
    pub mod sending;
    pub mod slots;
    pub mod tls;
}
