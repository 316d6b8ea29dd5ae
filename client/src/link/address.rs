//! Where a server is.

use rhytid_shared::RoomName;
use std::fmt;
use std::str::FromStr;
use tungstenite::http::Uri;

/// Port of a server that says nothing else.
const DEFAULT_PORT: u16 = 7878;

/// Host and port of a server, written `ws://HOST[:PORT]`, or `wss://HOST[:PORT]` where it is encrypted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerAddress {
    is_encrypted: bool,
    /// Name or address; IPv6 in brackets.
    host: String,
    port: u16,
}

/// One server, or several nodes of a cluster with commas between them, in the order in which they are tried.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerAddresses(Vec<ServerAddress>);

/// Most addresses that one viewer tries.
const MAX_SERVERS: usize = 64;

impl ServerAddresses {
    /// One or more.
    pub(super) fn all(&self) -> &[ServerAddress] {
        &self.0
    }

    /// The one that is asked first.
    pub fn first(&self) -> &ServerAddress {
        &self.0[0]
    }
}

impl fmt::Display for ServerAddresses {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (k, address) in self.0.iter().enumerate() {
            write!(f, "{}{address}", if k > 0 { ", " } else { "" })?;
        }
        Ok(())
    }
}

impl FromStr for ServerAddresses {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let all = text.split(',').take(MAX_SERVERS).map(|address| address.trim().parse());
        Ok(Self(all.collect::<Result<_, _>>()?))
    }
}

/// An address that is none.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    /// Not of the form.
    #[error("server address {got:?} is not ws://HOST[:PORT] or wss://HOST[:PORT]")]
    Form {
        /// What was given.
        got: String,
    },
}

impl ServerAddress {
    /// The socket of a room's viewers.
    pub(super) fn view_uri(&self, room: &RoomName) -> String {
        format!("{self}/v1/rooms/{room}/view")
    }

    /// A path on the same server over HTTP. `path` must begin with a slash.
    pub(crate) fn http_url(&self, path: &str) -> String {
        format!("{}://{}:{}{path}", if self.is_encrypted { "https" } else { "http" }, self.host, self.port)
    }

    /// True where the way there is under TLS.
    pub(super) fn is_encrypted(&self) -> bool {
        self.is_encrypted
    }

    /// Nobody else can read what goes there.
    pub(crate) fn may_carry_secrets(&self) -> bool {
        let is_here = self.host_and_port().0.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback());
        self.is_encrypted || is_here || self.host == "localhost"
    }

    /// As `ToSocketAddrs` wants it: IPv6 without its brackets.
    pub(super) fn host_and_port(&self) -> (&str, u16) {
        (self.host.trim_start_matches('[').trim_end_matches(']'), self.port)
    }
}

impl fmt::Display for ServerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}:{}", if self.is_encrypted { "wss" } else { "ws" }, self.host, self.port)
    }
}

impl FromStr for ServerAddress {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        let form = || AddressError::Form { got: text.to_owned() };
        let uri: Uri = text.parse().map_err(|_| form())?;
        let is_encrypted = match uri.scheme_str() {
            Some("ws") => false,
            Some("wss") => true,
            _ => return Err(form()),
        };
        let authority = uri.authority().ok_or_else(form)?;
        // `Uri` takes users, empty ports, paths and queries as well; none of them means anything here.
        let rest = text.split_once("://").map_or("", |(_, rest)| rest);
        let is_plain =
            rest.strip_suffix('/').unwrap_or(rest) == authority.as_str() && !rest.contains('@') && !authority.as_str().ends_with(':');
        if !is_plain || authority.host().is_empty() {
            return Err(form());
        }
        let port = match authority.port() {
            // A port beyond 65535 counts as none.
            None if authority.as_str() == authority.host() => DEFAULT_PORT,
            None => return Err(form()),
            Some(port) => port.as_str().parse().ok().filter(|&port| port != 0).ok_or_else(form)?,
        };
        Ok(Self { is_encrypted, host: authority.host().to_owned(), port })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_completed() {
        for (text, want) in [
            ("ws://127.0.0.1:7878", "ws://127.0.0.1:7878"),
            ("ws://face.example/", "ws://face.example:7878"),
            ("ws://[::1]:80", "ws://[::1]:80"),
            ("wss://face.example:443", "wss://face.example:443"),
        ] {
            assert_eq!(text.parse::<ServerAddress>().map(|address| address.to_string()), Ok(want.to_owned()));
        }
        let address: ServerAddress = "ws://[::1]:80".parse().unwrap();
        assert_eq!(address.host_and_port(), ("::1", 80));
        assert_eq!(address.view_uri(&RoomName::new("demo").unwrap()), "ws://[::1]:80/v1/rooms/demo/view");
        assert_eq!(address.http_url("/characters/a.glb"), "http://[::1]:80/characters/a.glb");
    }

    #[test]
    fn several_addresses_stand_with_commas_between_them() {
        let addresses: ServerAddresses = "ws://a:1, wss://b".parse().unwrap();
        assert_eq!((addresses.all().len(), addresses.to_string()), (2, "ws://a:1, wss://b:7878".to_owned()));
        assert!("ws://a,".parse::<ServerAddresses>().is_err());
    }

    #[test]
    fn wrong_addresses_are_refused_with_the_form_expected() {
        for text in [
            "",
            "127.0.0.1:7878",
            "http://host",
            "ws://",
            "ws://host:",
            "ws://host:0",
            "ws://host:99999",
            "ws://host/v1",
            "ws://a@host",
            "ws://host?x=1",
        ] {
            let error = text.parse::<ServerAddress>().unwrap_err();
            assert!(error.to_string().contains("ws://HOST[:PORT]"), "{text}: {error}");
        }
        let encrypted: ServerAddress = "wss://host".parse().unwrap();
        assert_eq!(encrypted.http_url("/characters/a.glb"), "https://host:7878/characters/a.glb");
    }
}
