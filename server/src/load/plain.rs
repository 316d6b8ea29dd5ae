//! What Rhytid is measured against: the broadcast server that everybody writes first. axum's own WebSockets with their default
//! buffers, one `tokio::sync::broadcast` channel a room, two tasks a viewer. It solves nothing, so its work is the lighter one.

use axum::Router;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Path, State};
use axum::http::StatusCode;
use axum::response::IntoResponse;
use axum::routing::get;
use futures_util::{SinkExt, StreamExt};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokio::net::TcpListener;
use tokio::sync::broadcast::{self, error::RecvError};

/// Messages that the channel holds for its slowest reader: as in the recipe.
const CAPACITY: usize = 100;

type Rooms = Arc<Mutex<HashMap<String, broadcast::Sender<Message>>>>;

/// Serves rooms at the paths of the real server until the process ends.
pub async fn serve_plain(listener: TcpListener) -> std::io::Result<()> {
    let app = Router::new().route("/v1/rooms/{room}/{end}", get(connect)).with_state(Rooms::default());
    axum::serve(listener, app).await
}

async fn connect(State(rooms): State<Rooms>, Path((room, end)): Path<(String, String)>, upgrade: WebSocketUpgrade) -> impl IntoResponse {
    let sender =
        rooms.lock().unwrap_or_else(PoisonError::into_inner).entry(room).or_insert_with(|| broadcast::Sender::new(CAPACITY)).clone();
    match end.as_str() {
        "publish" => upgrade.on_upgrade(move |socket| publish(socket, sender)),
        "view" => upgrade.on_upgrade(move |socket| view(socket, sender.subscribe())),
        _ => StatusCode::NOT_FOUND.into_response(),
    }
}

async fn publish(mut socket: WebSocket, sender: broadcast::Sender<Message>) {
    // What the real server says when frames may come.
    if socket.send(Message::text("{\"type\":\"ready\"}")).await.is_err() {
        return;
    }
    while let Some(Ok(message)) = socket.recv().await {
        if matches!(message, Message::Binary(_)) {
            // An error means that nobody is watching.
            let _ = sender.send(message);
        }
    }
}

async fn view(socket: WebSocket, mut receiver: broadcast::Receiver<Message>) {
    let (mut sink, mut stream) = socket.split();
    let mut sending = tokio::spawn(async move {
        if sink.send(Message::text("{\"type\":\"hello\"}")).await.is_err() {
            return;
        }
        loop {
            match receiver.recv().await {
                Ok(message) => {
                    if sink.send(message).await.is_err() {
                        return;
                    }
                }
                // The recipe ends here; going on is the kinder choice.
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return,
            }
        }
    });
    let mut receiving = tokio::spawn(async move { while let Some(Ok(_)) = stream.next().await {} });
    tokio::select! {
        _ = &mut sending => receiving.abort(),
        _ = &mut receiving => sending.abort(),
    }
}
