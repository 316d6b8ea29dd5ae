//! Recordings over HTTP: making them, listing them, and playing them into rooms.

use super::{admit, admit_to_listing, room_name};
use crate::recording::{PlayError, PlayRequest, RecordError, RecorderStatus, room_of_file};
use crate::service::{self, Hub};
use crate::socket::ErrorMessage;
use crate::token::Role;
use axum::extract::{Path, Request, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use rhytid_shared::RoomName;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

/// Most bytes of a word to a player; usual ones have 100.
const MOST_BODY: usize = 16 << 10;
/// What a page can show of a folder of recordings.
const MOST_LISTED: usize = 1000;

/// Begins or ends a recording, for who may publish to the room; answers with its file's name.
pub(super) async fn record(State(hub): State<Arc<Hub>>, Path((room, action)): Path<(String, String)>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    if let Err(answer) = admit(&hub, &request, Role::Publish, Some(&room)) {
        return *answer;
    }
    let answer = |status: RecorderStatus| axum::Json(serde_json::json!({ "recording": status })).into_response();
    match action.as_str() {
        "start" => {
            let place = match hub.rooms.room(&room) {
                Ok(place) => place,
                Err(error) => return ErrorMessage::new(error.code(), error.to_string()).response(StatusCode::SERVICE_UNAVAILABLE),
            };
            match service::record(&hub, &place).await {
                Ok(status) => answer(status),
                Err(error) => {
                    tracing::warn!(%room, %error, "recording refused");
                    let (code, status) = match error {
                        RecordError::NoFolder => ("no_recordings", StatusCode::FORBIDDEN),
                        RecordError::Running => ("recording_already", StatusCode::CONFLICT),
                        RecordError::TooMany { .. } => ("too_many_recordings", StatusCode::SERVICE_UNAVAILABLE),
                        RecordError::Create { .. } | RecordError::Write(_) => ("recording_failed", StatusCode::INTERNAL_SERVER_ERROR),
                    };
                    ErrorMessage::new(code, error.to_string()).response(status)
                }
            }
        }
        "stop" => match hub.rooms.find(&room).and_then(|place| place.end_recording()) {
            Some(status) => answer(status),
            None => ErrorMessage::new("not_recording", "the room is not being recorded").response(StatusCode::CONFLICT),
        },
        _ => ErrorMessage::new("not_found", "expected record/start or record/stop").response(StatusCode::NOT_FOUND),
    }
}

/// The recordings in the server's folder, newest first: all, for who may do everything, or those that the server has made of the
/// room that the query names, for who may publish to it.
pub(super) async fn list(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    let room = match admit_to_listing(&hub, &request, Role::Publish) {
        Ok(room) => room,
        Err(answer) => return *answer,
    };
    let Some(dir) = hub.recorder.dir().map(std::path::Path::to_owned) else {
        return axum::Json(serde_json::json!({ "recordings": [], "enabled": false })).into_response();
    };
    let files = tokio::task::spawn_blocking(move || recordings_in(dir, room.as_ref())).await.unwrap_or_default();
    let files: Vec<_> = files.into_iter().map(|(_, file, bytes)| serde_json::json!({ "file": file, "bytes": bytes })).collect();
    axum::Json(serde_json::json!({ "recordings": files, "enabled": true })).into_response()
}

/// When each was written last, its name and its length in bytes.
fn recordings_in(dir: PathBuf, room: Option<&RoomName>) -> Vec<(SystemTime, String, u64)> {
    let mut files: Vec<_> = std::fs::read_dir(dir)
        .into_iter()
        .flatten()
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().into_string().ok().filter(|name| name.ends_with(".mcap"))?;
            if room.is_some_and(|room| room_of_file(&name).as_ref() != Some(room)) {
                return None;
            }
            let file = entry.metadata().ok()?;
            Some((file.modified().ok()?, name, file.len()))
        })
        .collect();
    files.sort_by(|a, b| b.cmp(a));
    files.truncate(MOST_LISTED);
    files
}

/// What is played into the room, whether it is recorded, and whether it may be; for who may watch it.
pub(super) async fn status(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    let pass = match admit(&hub, &request, Role::View, Some(&room)) {
        Ok(pass) => pass,
        Err(answer) => return *answer,
    };
    let recording = hub.rooms.find(&room).and_then(|place| place.recording());
    let may_record = hub.recorder.dir().is_some();
    let may_control = pass.allows(Role::Publish, Some(&room));
    let status = serde_json::json!({
        "replay": hub.players.status(&room), "recording": recording, "enabled": may_record, "control": may_control,
    });
    axum::Json(status).into_response()
}

/// Plays a recording into the room, or tells its player what to do; for who may publish to the room, and of recordings those of
/// rooms that one may watch.
pub(super) async fn replay(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    let pass = match admit(&hub, &request, Role::Publish, Some(&room)) {
        Ok(pass) => pass,
        Err(answer) => return *answer,
    };
    let bad = |problem: String| ErrorMessage::new("bad_replay", format!("body: {problem}")).response(StatusCode::BAD_REQUEST);
    let body = match axum::body::to_bytes(request.into_body(), MOST_BODY).await {
        Ok(body) => body,
        Err(error) => return bad(error.to_string()),
    };
    let request: PlayRequest = match serde_json::from_slice(&body) {
        Ok(request) => request,
        Err(error) => return bad(error.to_string()),
    };
    match hub.players.request(&hub, &room, request, |recorded| pass.allows(Role::View, recorded)).await {
        Ok(status) => axum::Json(serde_json::json!({ "replay": status })).into_response(),
        Err(error) => {
            let (code, status) = match error {
                PlayError::Read(_) => ("bad_recording", StatusCode::UNPROCESSABLE_ENTITY),
                PlayError::Character { .. } => ("other_character", StatusCode::CONFLICT),
                PlayError::NoPlayer => ("not_playing", StatusCode::CONFLICT),
                PlayError::NoFolder => ("no_recordings", StatusCode::FORBIDDEN),
                PlayError::File { .. } => ("no_such_recording", StatusCode::NOT_FOUND),
                PlayError::Range { .. } => ("bad_replay", StatusCode::BAD_REQUEST),
                PlayError::TooMany => ("too_many_players", StatusCode::SERVICE_UNAVAILABLE),
                PlayError::Busy => ("player_busy", StatusCode::SERVICE_UNAVAILABLE),
                PlayError::Thread(_) => ("no_thread", StatusCode::SERVICE_UNAVAILABLE),
                PlayError::Room { code: code @ ("room_taken" | "slot_taken" | "room_elsewhere"), .. } => (code, StatusCode::CONFLICT),
                PlayError::Room { code, .. } => (code, StatusCode::SERVICE_UNAVAILABLE),
            };
            ErrorMessage::new(code, error.to_string()).response(status)
        }
    }
}

/// Ends the player of the room, for who may publish to it.
pub(super) async fn end(State(hub): State<Arc<Hub>>, Path(room): Path<String>, request: Request) -> Response {
    let room = match room_name(&room) {
        Ok(room) => room,
        Err(error) => return error.response(StatusCode::BAD_REQUEST),
    };
    if let Err(answer) = admit(&hub, &request, Role::Publish, Some(&room)) {
        return *answer;
    }
    match hub.players.stop(&room) {
        Some(status) => axum::Json(serde_json::json!({ "replay": status })).into_response(),
        None => ErrorMessage::new("not_playing", "nothing is played in this room").response(StatusCode::CONFLICT),
    }
}
