//! Sockets of a server's rooms.

use std::io::ErrorKind;
use std::net::TcpStream;
use std::time::Duration;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{Error, HandshakeError, Result, WebSocket, client};

/// Opens `path` of `/v1/rooms/`, as `demo/view?format=json`. Each read of the socket waits for `patience` at most.
pub fn open(address: &str, path: &str, headers: &[(&'static str, String)], patience: Duration) -> Result<WebSocket<TcpStream>> {
    let stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(patience))?;
    stream.set_nodelay(true)?;
    let mut request = format!("ws://{address}/v1/rooms/{path}").into_client_request()?;
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().expect("a test's header"));
    }
    match client(request, stream) {
        Ok((socket, _)) => Ok(socket),
        Err(HandshakeError::Failure(error)) => Err(error),
        Err(HandshakeError::Interrupted(_)) => Err(Error::Io(ErrorKind::TimedOut.into())),
    }
}
