//! Requests to a server.

use std::io::{Error, ErrorKind, Read, Result, Write};
use std::net::TcpStream;

/// Status and body of the answer. Each of `headers` is `Name: value`.
///
/// # Errors
/// Whatever keeps an answer from coming in time, or one that is not HTTP.
pub fn ask(address: &str, method: &str, path: &str, headers: &[&str], body: &str) -> Result<(u16, String)> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(super::process::PATIENCE))?;
    let headers: String = headers.iter().map(|header| format!("{header}\r\n")).collect();
    let length = body.len();
    write!(stream, "{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n{body}")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    let status = answer.strip_prefix("HTTP/1.1 ").and_then(|rest| rest.get(..3)?.parse().ok());
    let body = answer.split_once("\r\n\r\n").map(|(_, body)| body.to_owned());
    status.zip(body).ok_or_else(|| Error::new(ErrorKind::InvalidData, format!("no answer: {answer:?}")))
}
