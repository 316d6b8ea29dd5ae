//! Publish messages written for publishers that send none: trackers with protocols of their own.

use rhytid_shared::layout::Layout;
use rhytid_shared::view::PROTOCOL_VERSION;
use rhytid_shared::{ARKIT_NAMES, ChannelGroup, HeadPose, PublishHello, Settings, Slot, TrackingData, TrackingFrame};
use serde_json::{Map, Value, json};

/// The text of a hello.
pub(crate) fn of_hello(hello: &PublishHello) -> String {
    let mut fields = json!({ "type": "hello", "version": PROTOCOL_VERSION, "source": hello.source });
    if let Some(fps) = hello.fps {
        fields["fps"] = json!(fps);
    }
    match &hello.layout {
        Some(Layout::Named(names)) => fields["layout"] = json!(names),
        Some(Layout::Ibug68) => fields["layout"] = json!("ibug68"),
        Some(Layout::Mediapipe478) => fields["layout"] = json!("mediapipe478"),
        Some(Layout::OpenSeeFace66) => fields["layout"] = json!("openseeface66"),
        None => {}
    }
    if let Some(image) = hello.image {
        fields["image"] = json!(image);
    }
    if let Some(focal) = hello.focal {
        fields["focal"] = json!(focal);
    }
    let Slot { name, priority, groups } = &hello.slot;
    if hello.slot != Slot::default() {
        (fields["slot"], fields["priority"]) = (json!(name), json!(priority));
        fields["groups"] = groups.iter().map(ChannelGroup::name).collect();
    }
    if hello.settings != Settings::default() {
        fields["settings"] = json!(hello.settings);
    }
    fields.to_string()
}

/// The text of a frame; bones, which only messages carry, become a frame without a face.
pub(crate) fn of_frame(frame: &TrackingFrame) -> String {
    let mut fields = json!({ "type": "frame", "t": frame.t });
    let put_head = |fields: &mut Value, head: &Option<HeadPose>| {
        if let Some(head) = head {
            fields["head"] = json!({ "rotation": head.rotation.to_array(), "position": head.position.to_array() });
        }
    };
    match &frame.data {
        TrackingData::Landmarks { points, confidence } => {
            fields["landmarks"] = json!(points);
            if !confidence.is_empty() {
                fields["confidence"] = json!(confidence);
            }
        }
        TrackingData::Weights { weights, head } => {
            let weights: Map<String, Value> =
                ARKIT_NAMES.iter().zip(weights.iter()).map(|(name, weight)| ((*name).into(), json!(weight))).collect();
            fields["weights"] = weights.into();
            put_head(&mut fields, head);
        }
        TrackingData::Bones { .. } | TrackingData::NoFace => fields["face"] = json!(false),
    }
    fields.to_string()
}
