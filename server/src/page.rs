//! The page in the browser, from the server's own binary.

use crate::config::Access;
use axum::body::Bytes;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use std::io::Read;

/// A file of the bundle that `cargo xtask web` makes.
struct File {
    /// Path below `/`.
    name: &'static str,
    /// Its SHA-256 in quotes.
    tag: &'static str,
    /// `bytes` are a gzip stream: browsers take that over http, too, which they do not of brotli.
    is_compressed: bool,
    bytes: &'static [u8],
}

/// By name. Empty where the server was built without the bundle.
static FILES: &[File] = include!(concat!(env!("OUT_DIR"), "/files.rs"));

/// Where the page in the browser starts.
const START: &str = "index.html";
/// The page of the camera. Its tracker compiles JavaScript from text, which no other page may.
const CAMERA: &str = "track.html";

/// The page's icon.
const ICON: &str = "icon.svg";

/// The answer to a request for `path` where that names a file of the page; `/track` means `/track.html`.
pub(crate) fn answer(method: &Method, path: &str, headers: &HeaderMap, access: &Access) -> Option<Response> {
    if !matches!(*method, Method::GET | Method::HEAD) {
        return None;
    }
    let file = match path.strip_prefix('/')? {
        "" => find(START),
        // What browsers ask for beside a page that names no icon, such as the list of rooms.
        "favicon.ico" => find(ICON),
        name => find(name).or_else(|| find(&format!("{name}.html"))),
    }?;
    Some(file.answer(headers, access))
}

/// The page that stands in for it: what rooms there are, and how to get the real one.
pub(crate) fn stand_in(access: &Access) -> Response {
    let mut response = axum::response::Html(include_str!("page.html")).into_response();
    protect(response.headers_mut(), &policy("'unsafe-inline'", "'unsafe-inline'", access));
    response
}

fn find(name: &str) -> Option<&'static File> {
    FILES.iter().find(|file| file.name == name)
}

impl File {
    fn answer(&self, headers: &HeaderMap, access: &Access) -> Response {
        let mut response = match headers.get(header::IF_NONE_MATCH) {
            Some(known) if known.to_str().is_ok_and(|known| known.contains(self.tag)) => StatusCode::NOT_MODIFIED.into_response(),
            _ if !self.is_compressed => Bytes::from_static(self.bytes).into_response(),
            _ if takes_gzip(headers) => {
                ([(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"))], Bytes::from_static(self.bytes)).into_response()
            }
            _ => {
                let mut plain = Vec::new();
                match flate2::read::GzDecoder::new(self.bytes).read_to_end(&mut plain) {
                    Ok(_) => Bytes::from(plain).into_response(),
                    // The bytes are the build's own.
                    Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
                }
            }
        };
        let given = response.headers_mut();
        given.insert(header::CONTENT_TYPE, HeaderValue::from_static(content_type(self.name)));
        given.insert(header::ETAG, HeaderValue::from_static(self.tag));
        given.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
        // Asked for again each time, so that page and server are of one build.
        given.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        let scripts = if self.name == CAMERA { "'self' 'wasm-unsafe-eval' 'unsafe-eval'" } else { "'self' 'wasm-unsafe-eval'" };
        protect(given, &policy(scripts, "'self'", access));
        response
    }
}

/// What a page may do, by where its scripts and styles may come from. Allowed sites may show it in a frame.
fn policy(scripts: &str, styles: &str, access: &Access) -> String {
    let friends: String = access.origins.iter().map(|origin| format!(" {origin}")).collect();
    format!(
        "default-src 'none'; script-src {scripts}; style-src {styles}; img-src 'self' data: blob:; media-src 'self' blob:; \
         connect-src 'self'; frame-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'{friends}"
    )
}

fn protect(headers: &mut HeaderMap, policy: &str) {
    // Origins given on the command line may be no header at all; then nobody else frames the page.
    let policy = HeaderValue::from_str(policy).unwrap_or(HeaderValue::from_static("default-src 'none'"));
    headers.insert(header::CONTENT_SECURITY_POLICY, policy);
    for (name, value) in [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("permissions-policy"), "camera=(self), microphone=(), geolocation=()"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
}

/// Whether `Accept-Encoding` names gzip and does not weigh it with 0 (RFC 9110, 12.5.3).
fn takes_gzip(headers: &HeaderMap) -> bool {
    headers.get_all(header::ACCEPT_ENCODING).into_iter().filter_map(|value| value.to_str().ok()).flat_map(|value| value.split(',')).any(
        |coding| {
            let (name, weight) = coding.split_once(';').unwrap_or((coding, ""));
            let is_refused = weight.trim().strip_prefix("q=").is_some_and(|weight| weight.parse() == Ok(0.0));
            matches!(name.trim(), "gzip" | "x-gzip" | "*") && !is_refused
        },
    )
}

fn content_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "txt" => "text/plain; charset=utf-8",
        "json" | "webmanifest" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "wasm" => "application/wasm",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gzip_goes_to_who_takes_it() {
        let takes = |value: &str| {
            let headers = HeaderMap::from_iter([(header::ACCEPT_ENCODING, value.parse().unwrap())]);
            takes_gzip(&headers)
        };
        assert!(takes("gzip") && takes("br, gzip;q=0.5") && takes("*") && takes("deflate, x-gzip"));
        assert!(!takes("br") && !takes("gzip;q=0, br") && !takes("") && !takes_gzip(&HeaderMap::new()));
    }

    #[test]
    fn a_file_goes_out_compressed_whole_or_not_at_all() {
        static BYTES: &[u8] = &[0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3, 0x4b, 0x4c, 0x4a, 0x06, 0, 0xc2, 0x41, 0x24, 0x35, 3, 0, 0, 0];
        let file = File { name: "x.js", tag: "\"ab\"", is_compressed: true, bytes: BYTES };
        let answer = |name: HeaderName, value: &str| {
            let headers = HeaderMap::from_iter([(name, value.parse().unwrap())]);
            let response = file.answer(&headers, &Access::default());
            let policy = response.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
            assert!(!policy.contains("'unsafe-eval'") && policy.contains("frame-ancestors 'self'"), "{policy}");
            assert_eq!(response.headers()[header::CONTENT_TYPE], "text/javascript; charset=utf-8");
            response
        };
        let body = |response: Response| {
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            runtime.block_on(axum::body::to_bytes(response.into_body(), 100)).unwrap()
        };
        let packed = answer(header::ACCEPT_ENCODING, "gzip");
        assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
        assert_eq!(&*body(packed), BYTES);
        assert_eq!(&*body(answer(header::ACCEPT_ENCODING, "br")), b"abc");
        let known = answer(header::IF_NONE_MATCH, "\"ab\"");
        assert_eq!(known.status(), StatusCode::NOT_MODIFIED);
        assert!(body(known).is_empty());
    }

    #[test]
    fn only_the_cameras_page_may_compile_text() {
        let file = File { name: CAMERA, tag: "\"\"", is_compressed: false, bytes: b"" };
        let access = Access { origins: vec!["https://studio.example".into()], ..Access::default() };
        let response = file.answer(&HeaderMap::new(), &access);
        let policy = response.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(policy.contains("'unsafe-eval'") && policy.ends_with("frame-ancestors 'self' https://studio.example"), "{policy}");
    }
}
