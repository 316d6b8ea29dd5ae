//! Viewers: each gets the newest state and nothing else, however slow it is.
//!
//! Kernel buffers at both ends hold more than a thousand packets, most of them at the viewer's end where no option of ours
//! reaches. So the server looks at what the viewer has *read*: pings travel between the packets, a viewer that reads answers
//! them, and no more than a window of packets goes out unanswered ([`pace`]). What a sleeping viewer misses is never sent.
//!
//! A room's viewers are served by few tasks ([`audience`]), each of which holds many of them ([`member`]): what a frame costs is
//! the kernel's send and little else.

mod audience;
mod member;
mod pace;

pub(crate) use audience::Audience;
pub(crate) use member::Member;

use crate::framed::ping_and_text;
use crate::service::Hub;
use rhytid_shared::RoomName;
use rhytid_shared::view::{ViewHello, ViewMessage};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

/// Largest message of a viewer, bytes: it has nothing to say but pongs.
const LARGEST_MESSAGE: usize = 1024;

/// Small buffers: a viewer sends nothing but pongs, and packets go around the WebSocket.
pub(crate) fn socket_config() -> WebSocketConfig {
    const READ: usize = 256;
    const WRITE: usize = 512;
    WebSocketConfig::default()
        .read_buffer_size(READ)
        .write_buffer_size(WRITE)
        // Room for a last word and a control frame behind it.
        .max_write_buffer_size(16 << 10)
        .max_message_size(Some(LARGEST_MESSAGE))
        .max_frame_size(Some(LARGEST_MESSAGE))
}

/// What a viewer gets before its first packet: a ping, which shows whether it answers pings at all, and the hello.
pub(crate) fn first_frames(hub: &Hub, room: &RoomName) -> Vec<u8> {
    let hello = ViewMessage::Hello(ViewHello::new(room.as_str(), &hub.character, hub.character_url.clone()));
    ping_and_text(&serde_json::to_string(&hello).expect("plain data can be written"))
}
