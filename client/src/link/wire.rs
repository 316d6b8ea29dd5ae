//! A connection's bytes: plain, or under TLS.

use super::ServerAddress;
use rhytid_shared::trust::Trust;
use rustls::pki_types::ServerName;
use rustls::{ClientConnection, StreamOwned};
use std::io::{self, Read, Write};
use std::net::TcpStream;

/// Blocking, with the time-outs of its TCP stream. A read that timed out may be tried again, also under TLS.
pub(super) enum Wire {
    /// As they are.
    Plain(TcpStream),
    /// Under TLS.
    Encrypted(Box<StreamOwned<ClientConnection, TcpStream>>),
}

impl Wire {
    /// Shakes hands where `server` is encrypted.
    pub fn new(stream: TcpStream, server: &ServerAddress, trust: &Trust) -> io::Result<Self> {
        if !server.is_encrypted() {
            return Ok(Self::Plain(stream));
        }
        let config = trust.client_config().map_err(io::Error::other)?;
        let name = ServerName::try_from(server.host_and_port().0.to_owned()).map_err(io::Error::other)?;
        let connection = ClientConnection::new(config, name).map_err(io::Error::other)?;
        let mut stream = StreamOwned::new(connection, stream);
        // Now, so that what is wrong with the certificate is not taken for a lost connection later.
        while stream.conn.is_handshaking() {
            stream.conn.complete_io(&mut stream.sock)?;
        }
        Ok(Self::Encrypted(Box::new(stream)))
    }

    /// The TCP stream below.
    pub fn tcp(&self) -> &TcpStream {
        match self {
            Self::Plain(stream) => stream,
            Self::Encrypted(stream) => &stream.sock,
        }
    }
}

impl Read for Wire {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(stream) => stream.read(buffer),
            Self::Encrypted(stream) => stream.read(buffer),
        }
    }
}

impl Write for Wire {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(stream) => stream.write(bytes),
            Self::Encrypted(stream) => stream.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(stream) => stream.flush(),
            Self::Encrypted(stream) => stream.flush(),
        }
    }
}
