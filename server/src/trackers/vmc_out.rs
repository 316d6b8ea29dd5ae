//! A room's face as VMC, to a program that takes it: a viewer of the room inside the server.

use super::spec::VmcOutSpec;
use super::vmc;
use crate::room::Viewing;
use crate::service::{Hub, ServerError, stopped};
use rhytid_shared::FaceFrame;
use rhytid_shared::packet::Decoder;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::UdpSocket;

/// Shortest time between two faces: programs that take them draw 60 to 144 pictures a second.
const SHORTEST: Duration = Duration::from_millis(4);
/// A room that is full is asked for again this often.
const RETRY: Duration = Duration::from_secs(1);

/// An address that gets a room's face.
pub(crate) struct VmcOut {
    spec: VmcOutSpec,
    socket: UdpSocket,
}

impl VmcOut {
    pub async fn bind(spec: &VmcOutSpec) -> Result<Self, ServerError> {
        let any: SocketAddr = if spec.address.is_ipv4() { (Ipv4Addr::UNSPECIFIED, 0).into() } else { (Ipv6Addr::UNSPECIFIED, 0).into() };
        let socket = UdpSocket::bind(any).await;
        let socket = socket.map_err(|source| ServerError::Listen { address: format!("{any} (udp, to {})", spec.address), source })?;
        Ok(Self { spec: spec.clone(), socket })
    }
}

/// Starts a task for each.
pub(crate) fn start(hub: &Arc<Hub>, outs: Vec<VmcOut>) {
    for out in outs {
        tracing::info!(room = %out.spec.room, to = %out.spec.address, "sending VMC (udp)");
        let hub = hub.clone();
        tokio::spawn(async move {
            let mut shutdown = hub.shutdown.clone();
            tokio::select! {
                () = stopped(&mut shutdown) => {}
                () = run(&hub, &out) => {}
            }
        });
    }
}

async fn run(hub: &Hub, out: &VmcOut) {
    let mut viewing: Viewing = loop {
        match hub.rooms.join(&out.spec.room) {
            Ok(viewing) => break viewing,
            Err(error) => {
                tracing::debug!(%error, room = %out.spec.room, "no place for VMC out");
                tokio::time::sleep(RETRY).await;
            }
        }
    };
    let mut decoder = Decoder::new(hub.layout.clone());
    let mut frame = hub.layout.frame_at_rest();
    let mut key = 0;
    let mut start: Option<(u32, u64)> = None;
    viewing.slot.mark_changed();
    while viewing.slot.changed().await.is_ok() {
        let Some(latest) = viewing.slot.borrow_and_update().clone() else { continue };
        if key != latest.key.index {
            key = latest.key.index;
            decoder.decode(latest.key.framed.payload(), &mut frame).expect("a packet of the room's own encoder can be read");
        }
        if let Some(delta) = &latest.delta {
            decoder.decode(delta.payload(), &mut frame).expect("a packet of the room's own encoder can be read");
        }
        // Each session has its own clock.
        let (_, began) =
            *start.insert(start.filter(|(session, _)| *session == frame.session).unwrap_or((frame.session, frame.captured_at_micros)));
        for bundle in bundles(&frame, began) {
            match out.socket.send_to(&bundle, out.spec.address).await {
                Ok(_) => {
                    hub.metrics.bytes_out.inc_by(bundle.len() as u64);
                }
                Err(error) => tracing::debug!(%error, to = %out.spec.address, "cannot send VMC"),
            }
        }
        hub.metrics.vmc_frames_out.inc();
        tokio::time::sleep(SHORTEST).await;
    }
}

fn bundles(frame: &FaceFrame, began: u64) -> Vec<Vec<u8>> {
    let seconds = frame.captured_at_micros.saturating_sub(began) as f64 / 1e6;
    vmc::write(seconds as f32, frame.shapes.as_ref(), frame.head.rotation)
}
