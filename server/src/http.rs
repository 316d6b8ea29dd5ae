//! What is asked for over HTTP: pages, listings, the character, and the two kinds of WebSocket.

mod recordings;

use crate::config::Access;
use crate::service::{Hub, Peer, Place};
use crate::socket::{Ending, ErrorMessage, Handshake, close, tokens, upgrade};
use crate::token::{Claims, Refusal, Role, now_seconds};
use crate::viewer::{self, Member};
use crate::{control, page, publish, room};
use axum::Router;
use axum::body::Bytes;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use rhytid_shared::view::TOKEN_PROTOCOL;
use rhytid_shared::{RoomName, Slot};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

/// All routes.
pub(crate) fn router(hub: Arc<Hub>) -> Router {
    Router::new()
        .route("/", get(start_page))
        .route("/healthz", get(health))
        .route("/metrics", get(metrics))
        .route("/api/access", get(access))
        .route("/api/rooms", get(rooms))
        .route("/api/rooms/{room}/record/{action}", post(recordings::record))
        .route("/api/recordings", get(recordings::list))
        .route("/api/rooms/{room}/replay", get(recordings::status).post(recordings::replay).delete(recordings::end))
        .route("/api/trackers", get(trackers))
        .route("/api/profiles", get(profiles))
        .route("/characters/{file}", get(character))
        .route("/v1/rooms/{room}/publish", get(publish_socket))
        .route("/v1/rooms/{room}/control", get(control_socket))
        .route("/v1/rooms/{room}/view", get(view_socket))
        .fallback(other)
        .layer(from_fn_with_state(hub.clone(), check_browser))
        .with_state(hub)
}

/// Browsers carry other sites' pages: a request with an `Origin` must come from this server's own page or an allowed site, and
/// the server must be asked for by an address or a name it is known by, or a page elsewhere could reach it by a name of its
/// own that points here.
async fn check_browser(State(hub): State<Arc<Hub>>, request: Request, next: Next) -> Response {
    let access = &hub.config.access;
    match check_names(request.headers(), access, hub.listens_on_loopback) {
        Ok(()) => {
            let origin = request.headers().get(header::ORIGIN).filter(|origin| is_allowed_origin(origin, access)).cloned();
            let mut response = next.run(request).await;
            if !access.origins.is_empty() {
                response.headers_mut().append(header::VARY, HeaderValue::from_static("origin"));
            }
            // A page of an allowed site may also read what it gets.
            if let Some(origin) = origin {
                response.headers_mut().insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
            }
            response
        }
        Err(error) => {
            hub.metrics.end(error.code);
            tracing::warn!(code = error.code, message = error.message, "browser request refused");
            error.response(StatusCode::FORBIDDEN)
        }
    }
}

fn check_names(headers: &HeaderMap, access: &Access, listens_on_loopback: bool) -> Result<(), ErrorMessage> {
    let shown = |text: &str| text.chars().take(80).collect::<String>();
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let name = host_name(host);
    let is_listed = access.hosts.iter().any(|allowed| allowed.eq_ignore_ascii_case(name));
    let is_known = match name.trim_matches(['[', ']']).parse::<IpAddr>() {
        // Nobody can make an address point elsewhere.
        Ok(address) => address.is_loopback() || !listens_on_loopback,
        Err(_) => name.eq_ignore_ascii_case("localhost"),
    };
    if !is_listed && !is_known {
        let message =
            format!("header Host is {:?}, expected localhost, an address of this server or a name given with --allow-host", shown(host));
        return Err(ErrorMessage::new("forbidden_host", message));
    }
    let Some(origin) = headers.get(header::ORIGIN) else { return Ok(()) };
    let shown_origin = origin.to_str().unwrap_or_default();
    let is_own = shown_origin.split_once("://").is_some_and(|(_, origin_host)| origin_host.eq_ignore_ascii_case(host));
    if is_own || is_allowed_origin(origin, access) {
        return Ok(());
    }
    let message = format!(
        "header Origin is {:?}, expected this server's own page (Host {:?}) or one given with --allow-origin",
        shown(shown_origin),
        shown(host)
    );
    Err(ErrorMessage::new("forbidden_origin", message))
}

fn is_allowed_origin(origin: &HeaderValue, access: &Access) -> bool {
    access.origins.iter().any(|allowed| allowed.as_bytes().eq_ignore_ascii_case(origin.as_bytes()))
}

/// `host` without its port.
fn host_name(host: &str) -> &str {
    match host.rsplit_once(':') {
        // An IPv6 address without a port ends with its bracket.
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    }
}

/// What somebody who was let in may do.
#[derive(Clone)]
pub(crate) struct Pass {
    /// When the token's time is over.
    pub expires: Option<Instant>,
    /// The connection's place among all.
    pub place: Option<Arc<Place>>,
    /// What the token says, where one is demanded.
    claims: Option<Claims>,
}

impl Pass {
    /// Whether its bearer may act as `role` in `room` too, or in all of them.
    fn allows(&self, role: Role, room: Option<&RoomName>) -> bool {
        self.claims.as_ref().is_none_or(|claims| claims.allow(role, room).is_ok())
    }
}

/// Lets a request in whose token allows `role`, in `room` where it is about one; or says why not.
fn admit(hub: &Hub, request: &Request, role: Role, room: Option<&RoomName>) -> Result<Pass, Box<Response>> {
    let place = request.extensions().get::<Arc<Place>>().cloned();
    let Some(checker) = &hub.tokens else { return Ok(Pass { expires: None, place, claims: None }) };
    let is_near = request.extensions().get::<Peer>().is_some_and(|peer| peer.0.ip().to_canonical().is_loopback());
    let is_safe = hub.is_encrypted || is_near || hub.config.access.insecure;
    let end = bearer(request.headers()).ok_or(Refusal::Missing).and_then(|token| {
        // Whoever listens on the way has it by now, but learns not to use it.
        let claims = if is_safe { checker.check(token)? } else { return Err(Refusal::InTheClear) };
        Ok((claims.allow(role, room)?, claims))
    });
    match end {
        Ok((end, claims)) => {
            let expires = Instant::now() + Duration::from_secs(end.saturating_sub(now_seconds()));
            Ok(Pass { expires: Some(expires), place, claims: Some(claims) })
        }
        Err(refusal) => {
            let (code, words) = refusal.words();
            hub.metrics.end(code);
            tracing::warn!(code, peer = ?request.extensions().get::<Peer>(), "request refused");
            let status = match refusal {
                Refusal::Missing | Refusal::Bad | Refusal::Expired => StatusCode::UNAUTHORIZED,
                Refusal::InTheClear | Refusal::Role | Refusal::Room => StatusCode::FORBIDDEN,
            };
            let mut answer = ErrorMessage::new(code, words).response(status);
            if status == StatusCode::UNAUTHORIZED {
                answer.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
            }
            Err(answer.into())
        }
    }
}

/// The token of a request: from its header, or from among the subprotocols, the one place a browser's page can put one for a
/// WebSocket. Never from the address, which is logged on the way.
fn bearer(headers: &HeaderMap) -> Option<&str> {
    let from_header = headers.get(header::AUTHORIZATION).and_then(|value| {
        let (scheme, token) = value.to_str().ok()?.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
    });
    from_header.or_else(|| tokens(headers, &header::SEC_WEBSOCKET_PROTOCOL).find_map(|word| word.strip_prefix(TOKEN_PROTOCOL)))
}

async fn start_page(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    page::answer(request.method(), "/", request.headers(), &hub.config.access).unwrap_or_else(|| page::stand_in(&hub.config.access))
}

async fn other(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    page::answer(request.method(), request.uri().path(), request.headers(), &hub.config.access)
        .unwrap_or_else(|| ErrorMessage::new("not_found", "there is nothing at this address").response(StatusCode::NOT_FOUND))
}

/// Whether the bearer of the request's token may act as `role` in `room`, or in all of them. A browser's page, which cannot
/// read why a socket was refused, asks here.
async fn access(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    let role = match query_field(&request, "role") {
        Some("view") => Role::View,
        Some("publish") => Role::Publish,
        Some("admin") => Role::Admin,
        _ => {
            return ErrorMessage::new("unknown_role", "query field role is expected to be view, publish or admin")
                .response(StatusCode::BAD_REQUEST);
        }
    };
    let room = match query_field(&request, "room").map(room_name).transpose() {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    match admit(&hub, &request, role, room.as_ref()) {
        Ok(pass) => {
            let seconds = pass.expires.map(|end| end.saturating_duration_since(Instant::now()).as_secs());
            axum::Json(serde_json::json!({ "tokens": hub.tokens.is_some(), "seconds": seconds })).into_response()
        }
        Err(answer) => *answer,
    }
}

/// In Prometheus's own format, or as OpenMetrics where the reader names that.
async fn metrics(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    if let Err(answer) = admit(&hub, &request, Role::Admin, None) {
        return *answer;
    }
    let mut accepted = request.headers().get_all(header::ACCEPT).into_iter().filter_map(|value| value.to_str().ok());
    let (kind, text) = if accepted.any(|value| value.contains("application/openmetrics-text")) {
        ("application/openmetrics-text; version=1.0.0; charset=utf-8", hub.metrics.open_metrics())
    } else {
        ("text/plain; version=0.0.4; charset=utf-8", hub.metrics.prometheus())
    };
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}

/// `ok`, or what this node lacks of its cluster: its own rooms go on, so it is healthy all the same.
async fn health(State(hub): State<Arc<Hub>>) -> String {
    match hub.cluster.as_ref().and_then(|cluster| cluster.problem()) {
        Some(problem) => format!("degraded: {problem}\n"),
        None => "ok\n".to_owned(),
    }
}

/// All rooms, for who may do everything; or the one that the query names, for who may watch it. Where there are other nodes,
/// theirs, too: each room once, as its home tells of it.
async fn rooms(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    let asked = match admit_to_listing(&hub, &request, Role::View) {
        Ok(asked) => asked,
        Err(answer) => return *answer,
    };
    let own = match &asked {
        Some(name) => hub.rooms.find(name).iter().map(|room| room.listing()).collect(),
        None => hub.rooms.list(),
    };
    let Some(cluster) = &hub.cluster else { return axum::Json(serde_json::json!({ "rooms": own })).into_response() };
    let rooms = room::merge(cluster.node(), own, cluster.elsewhere(asked.as_ref()));
    axum::Json(serde_json::json!({ "node": cluster.node(), "nodes": cluster.nodes(), "rooms": rooms })).into_response()
}

/// Lets in who may see a listing: of the room that the query names, as `role`, or of all there is.
fn admit_to_listing(hub: &Hub, request: &Request, role: Role) -> Result<Option<RoomName>, Box<Response>> {
    let room = query_field(request, "room").map(room_name).transpose().map_err(|error| error.response(StatusCode::BAD_REQUEST))?;
    admit(hub, request, if room.is_some() { role } else { Role::Admin }, room.as_ref())?;
    Ok(room)
}

async fn trackers(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    if let Err(answer) = admit(&hub, &request, Role::Admin, None) {
        return *answer;
    }
    axum::Json(serde_json::json!({ "ports": hub.trackers.list() })).into_response()
}

/// For who may do everything, or who publishes to the room that the query names: a publisher chooses one of them by name.
async fn profiles(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    if let Err(answer) = admit_to_listing(&hub, &request, Role::Publish) {
        return *answer;
    }
    axum::Json(serde_json::json!({ "profiles": hub.profiles.list() })).into_response()
}

async fn character(State(hub): State<Arc<Hub>>, Path(file): Path<String>, headers: HeaderMap) -> Response {
    if hub.character_url.strip_prefix("/characters/") != Some(file.as_str()) {
        let message = format!("this server's character is at {}", hub.character_url);
        return ErrorMessage::new("not_found", message).response(StatusCode::NOT_FOUND);
    }
    let tag = format!("\"{}\"", hub.character.sha256);
    let known = headers.get(header::IF_NONE_MATCH).is_some_and(|given| given.as_bytes() == tag.as_bytes());
    let describe = [(header::ETAG, tag), (header::CACHE_CONTROL, "no-cache".into()), (header::CONTENT_TYPE, "model/gltf-binary".into())];
    if known {
        return (StatusCode::NOT_MODIFIED, describe).into_response();
    }
    (describe, Bytes::clone(&hub.glb)).into_response()
}

fn room_name(text: &str) -> Result<RoomName, ErrorMessage> {
    RoomName::new(text).map_err(|error| ErrorMessage::new("bad_room_name", error.to_string()))
}

async fn publish_socket(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    tracing::debug!(%room, peer = ?request.extensions().get::<Peer>(), "publisher connects");
    let handshake = match Handshake::check(&request) {
        Ok(handshake) => handshake,
        Err(answer) => return *answer,
    };
    let pass = match admit(&hub, &request, Role::Publish, Some(&room)) {
        Ok(pass) => pass,
        Err(answer) => return *answer,
    };
    let config = publish::socket_config(&hub);
    upgrade(&hub.clone(), request, handshake, config, Vec::new(), move |socket| publish::talk(hub, socket, room, pass))
}

async fn control_socket(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    let slot = query_field(&request, "slot").unwrap_or(Slot::MAIN).to_owned();
    let handshake = match Handshake::check(&request) {
        Ok(handshake) => handshake,
        Err(answer) => return *answer,
    };
    // Who speaks for a source may do to its face what its publisher may.
    let pass = match admit(&hub, &request, Role::Publish, Some(&room)) {
        Ok(pass) => pass,
        Err(answer) => return *answer,
    };
    let config = publish::socket_config(&hub);
    let target = control::Target { hub: hub.clone(), room, slot };
    upgrade(&hub, request, handshake, config, Vec::new(), move |socket| control::talk(target, socket, pass))
}

/// A field of the request's query.
fn query_field<'a>(request: &'a Request, name: &str) -> Option<&'a str> {
    let query = request.uri().query().unwrap_or_default();
    query.split('&').find_map(|pair| pair.split_once('=').filter(|(key, _)| *key == name)).map(|(_, value)| value)
}

async fn view_socket(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    let format = query_field(&request, "format").unwrap_or("binary");
    if !matches!(format, "json" | "binary") {
        let message = format!("query field format is {:?}, expected json or binary", format.chars().take(40).collect::<String>());
        return ErrorMessage::new("unknown_format", message).response(StatusCode::BAD_REQUEST);
    }
    let wants_json = format == "json";
    // Before the room: what is no handshake makes none.
    let handshake = match Handshake::check(&request) {
        Ok(handshake) => handshake,
        Err(answer) => return *answer,
    };
    let pass = match admit(&hub, &request, Role::View, Some(&room)) {
        Ok(pass) => pass,
        Err(answer) => return *answer,
    };
    tracing::debug!(%room, wants_json, peer = ?request.extensions().get::<Peer>(), "viewer connects");
    match hub.rooms.join(&room) {
        Ok(viewing) => {
            let (first, config) = (viewer::first_frames(&hub, &room), viewer::socket_config());
            let place = request.extensions().get::<Arc<Place>>().cloned();
            upgrade(&hub.clone(), request, handshake, config, first, async move |socket| {
                let room = viewing.room.clone();
                room.audience.enter(&hub, Member::new(socket, viewing, wants_json, pass.expires, place));
            })
        }
        // A browser's page cannot read the answer to a handshake, so the refusal is a message.
        Err(error) => {
            let ending = Ending::error(CloseCode::Again, ErrorMessage::new(error.code(), error.to_string()));
            hub.metrics.end(error.code());
            upgrade(&hub, request, handshake, viewer::socket_config(), Vec::new(), async move |socket| close(socket, &ending).await)
        }
    }
}
