//! One publish session's messages, checked in their order.

use super::binary;
use super::fields::{Fields, Kind, LayoutField};
use super::values::cut;
use super::{
    Command, FIT_SECONDS, FitRequest, FitStep, MessageError, PublishHello, PublishMessage, Resume, Settings, Slot, TrackingData,
    TrackingFrame,
};
use crate::character::Character;
use crate::face::HeadPose;
use crate::layout::Layout;
use crate::limits::{FOCAL_RANGE, MAX_FEATURE_POINTS, MAX_RESUME_KEY, MAX_SECONDS};
use crate::names::{NUM_ARKIT_SHAPES, RoomName};
use crate::view::PROTOCOL_VERSION;
use std::collections::{BTreeMap, BTreeSet};

/// Largest side of a tracker's picture, pixels.
const MAX_IMAGE: f64 = 1e5;
/// Most frames a second a hello may claim: faster than any face camera.
const MAX_FPS: f64 = 1000.0;

/// Types of a publisher's messages, for errors.
pub(super) const TYPES: &str = "\"hello\", \"frame\", \"calibrate\", \"recentre\", \"settings\", \"fit\" or \"profile\"";
/// Types of commands, for errors.
const COMMANDS: &str = "\"calibrate\", \"recentre\", \"settings\", \"fit\" or \"profile\"";
/// Steps of the fit, for errors.
const STEPS: &str = "neutral, brows_up, frown, smile, pucker, jaw_open, blink, mouth_left, finish or cancel";
/// How long a step measures where nothing is said.
const DEFAULT_FIT_SECONDS: f64 = 1.5;

/// Reads the text messages of one publish session, or the lines of a feed file, without building a tree of JSON.
#[derive(Debug, Clone)]
pub struct PublishReader {
    /// `None` where the character is not known here.
    names: Option<Names>,
    fields: Fields,
    hello: Option<PublishHello>,
    last_t: Option<f64>,
    /// `last_t` as it was before the newest frame.
    t_before: Option<f64>,
}

/// What a character calls its parts.
#[derive(Debug, Clone)]
pub(super) struct Names {
    pub(super) bones: BTreeMap<String, usize>,
    features: BTreeSet<String>,
    /// In the order of its table; empty for a character without wrinkle zones.
    pub(super) expressions: Vec<String>,
}

impl PublishReader {
    /// A reader for a session that drives `character`, whose names `bones` and named layouts must use.
    pub fn new(character: &Character) -> Self {
        let names = Names {
            bones: character.bones.iter().enumerate().map(|(i, bone)| (bone.name.clone(), i)).collect(),
            features: character.features.keys().cloned().collect(),
            expressions: character.zones.iter().flat_map(|zones| &zones.expressions).map(|row| row.name.clone()).collect(),
        };
        Self { names: Some(names), fields: Fields::new(), hello: None, last_t: None, t_before: None }
    }

    /// A reader for a sender, which does not know the character at the other end: names of bones, of
    /// feature points and of expressions are not checked, and the bones and expressions of a frame are left out.
    pub fn for_any_character() -> Self {
        Self { names: None, fields: Fields::new(), hello: None, last_t: None, t_before: None }
    }

    /// Reads one message. A frame is written into `frame`, whose buffers are reused; after an error `frame` is as it was.
    pub fn read(&mut self, text: &str, frame: &mut TrackingFrame) -> Result<PublishMessage, MessageError> {
        self.fields.read(text, self.names.as_ref())?;
        if let Some(problem) = self.fields.problem.take() {
            return Err(problem);
        }
        let kind = self.fields.kind.ok_or_else(|| missing("type", TYPES))?;
        match (kind, &self.hello) {
            (Kind::Hello, Some(_)) => {
                Err(MessageError::new("repeated_hello", "field type is \"hello\" a second time, expected one hello a session"))
            }
            (Kind::Hello, None) => {
                let hello = self.check_hello()?;
                self.hello = Some(hello.clone());
                Ok(PublishMessage::Hello(hello))
            }
            (_, None) => Err(MessageError::new("no_hello", "the first message must be {\"type\":\"hello\",\"version\":1,…}")),
            (Kind::Frame, Some(_)) => self.check_frame(frame).map(|()| PublishMessage::Frame),
            (kind, Some(_)) => check_command(kind, &mut self.fields).map(PublishMessage::Command),
        }
    }

    /// Reads one message of a control socket, which brings no frames and needs no hello.
    pub fn read_command(text: &str) -> Result<Command, MessageError> {
        let mut fields = Fields::new();
        fields.read(text, None)?;
        if let Some(problem) = fields.problem.take() {
            return Err(problem);
        }
        let kind = fields.kind.ok_or_else(|| missing("type", COMMANDS))?;
        check_command(kind, &mut fields)
    }

    /// Reads one binary message, which is a landmark frame (see `encode_landmarks`). After an error `frame` is as it was.
    pub fn read_binary(&mut self, bytes: &[u8], frame: &mut TrackingFrame) -> Result<PublishMessage, MessageError> {
        let Some(hello) = &self.hello else {
            return Err(MessageError::new("no_hello", "the first message must be the text {\"type\":\"hello\",\"version\":1,…}"));
        };
        let layout = hello
            .layout
            .as_ref()
            .ok_or_else(|| MessageError::new("no_layout", "frame has landmarks, expected field layout in the hello to say which"))?;
        let t = binary::decode(bytes, layout.num_points(), &mut self.fields.landmarks, &mut self.fields.confidence)?;
        self.check_time(t)?;
        take_landmarks(&mut self.fields, &mut frame.data);
        frame.expressions = None;
        frame.t = t;
        self.t_before = self.last_t.replace(t);
        Ok(PublishMessage::Frame)
    }

    /// The frame last read was refused by what comes after the reader: the session's clock stands as it did before that frame,
    /// so that one bad time does not shut out all later frames.
    pub fn take_back(&mut self) {
        self.last_t = self.t_before;
    }

    fn check_hello(&mut self) -> Result<PublishHello, MessageError> {
        let fields = &mut self.fields;
        let version = fields.version.ok_or_else(|| missing("version", "1"))?;
        if version != f64::from(PROTOCOL_VERSION) {
            return Err(MessageError::new("unknown_version", format!("field version is {version}, this server speaks {PROTOCOL_VERSION}")));
        }
        let within = |field: &str, value: f64, most: f64, unit: &str| {
            if value > 0.0 && value <= most {
                Ok(value as f32)
            } else {
                Err(MessageError::new("out_of_range", format!("field {field} is {value}, expected {unit}, more than 0 and at most {most}")))
            }
        };
        let layout =
            fields.layout.take().map(|layout| check_layout(layout, self.names.as_ref().map(|names| &names.features))).transpose()?;
        let image = match fields.image {
            Some([width, height]) => {
                Some([within("image[0]", width, MAX_IMAGE, "pixels")?, within("image[1]", height, MAX_IMAGE, "pixels")?])
            }
            None => None,
        };
        if layout.is_some() && image.is_none() {
            return Err(missing("image", "[width, height] of the tracker's picture, because the hello names a layout"));
        }
        Ok(PublishHello {
            source: fields.source.take().unwrap_or_default(),
            fps: fields.fps.map(|fps| within("fps", fps, MAX_FPS, "frames a second")).transpose()?,
            layout,
            image,
            focal: fields.focal.map(|focal| check_focal(focal, image)).transpose()?,
            takeover: fields.takeover,
            resume: fields.resume.map(|session| check_resume(session, fields.resume_key.take())).transpose()?,
            settings: check_settings(fields.settings)?,
            slot: Slot::check(fields.slot.take(), fields.priority, fields.groups)?,
            keep_neutral: fields.keep_neutral,
            profile: fields.profile.take(),
        })
    }

    fn check_time(&self, t: f64) -> Result<(), MessageError> {
        // A NaN is in no range.
        if !(0.0..=MAX_SECONDS).contains(&t) {
            return Err(MessageError::new("out_of_range", format!("field t is {t}, expected seconds from 0 to {MAX_SECONDS}")));
        }
        match self.last_t {
            Some(last) if t <= last => {
                Err(MessageError::new("time_order", format!("field t is {t}, expected more than the {last} of the frame before")))
            }
            _ => Ok(()),
        }
    }

    fn check_frame(&mut self, frame: &mut TrackingFrame) -> Result<(), MessageError> {
        let t = self.fields.t.ok_or_else(|| missing("t", "seconds on the sender's clock"))?;
        self.check_time(t)?;
        let fields = &mut self.fields;
        let head = (fields.head_rotation.is_some() || fields.head_position.is_some())
            .then(|| HeadPose { rotation: fields.head_rotation.unwrap_or_default(), position: fields.head_position.unwrap_or_default() });
        match (fields.has_landmarks, fields.has_weights, fields.has_bones) {
            _ if fields.face == Some(false) => frame.data = TrackingData::NoFace,
            (true, false, false) => check_landmarks(fields, self.hello.as_ref().and_then(|hello| hello.layout.as_ref()), &mut frame.data)?,
            (false, true, false) => {
                if !matches!(frame.data, TrackingData::Weights { .. }) {
                    frame.data = TrackingData::Weights { weights: Box::new([0.0; NUM_ARKIT_SHAPES]), head: None };
                }
                if let TrackingData::Weights { weights, head: slot } = &mut frame.data {
                    weights.copy_from_slice(&fields.weights[..]);
                    *slot = head;
                }
            }
            (false, false, true) => {
                if !matches!(frame.data, TrackingData::Bones { .. }) {
                    frame.data = TrackingData::Bones { points: Vec::new(), head: None };
                }
                if let TrackingData::Bones { points, head: slot } = &mut frame.data {
                    std::mem::swap(points, &mut fields.bones);
                    *slot = head;
                }
            }
            (false, false, false) if fields.has_expressions => {
                if self.names.as_ref().is_some_and(|names| names.expressions.is_empty()) {
                    return Err(MessageError::new(
                        "no_expressions",
                        "frame has only the field expressions, and this character has none, expected landmarks, weights or bones",
                    ));
                }
                // A face at rest, to wrinkle by expressions alone.
                frame.data = TrackingData::Bones { points: Vec::new(), head };
            }
            (false, false, false) => {
                return Err(missing("landmarks", "landmarks, weights, bones, expressions or \"face\":false in a frame"));
            }
            _ => {
                return Err(MessageError::new(
                    "ambiguous_frame",
                    "frame has several of the fields landmarks, weights and bones, expected one of them",
                ));
            }
        }
        // A character without a table has no use for them; what came with them still counts.
        let has_table = self.names.as_ref().is_some_and(|names| !names.expressions.is_empty());
        frame.expressions = (has_table && fields.has_expressions && fields.face != Some(false)).then_some(fields.expressions);
        frame.t = t;
        self.t_before = self.last_t.replace(t);
        Ok(())
    }
}

/// What a command's fields say.
fn check_command(kind: Kind, fields: &mut Fields) -> Result<Command, MessageError> {
    match kind {
        Kind::Calibrate => Ok(Command::Calibrate),
        Kind::Recentre => Ok(Command::Recentre),
        Kind::Settings => {
            fields.change.check()?;
            Ok(Command::Settings(fields.change))
        }
        Kind::Profile => {
            let choice = fields.profile.take().ok_or_else(|| missing("profile", "a profile, or the name of one that the server keeps"))?;
            Ok(Command::Profile(choice))
        }
        Kind::Fit => check_fit(fields).map(Command::Fit),
        Kind::Hello | Kind::Frame => {
            Err(MessageError::new("unknown_type", format!("field type is that of a publisher, expected {COMMANDS}")))
        }
    }
}

fn check_fit(fields: &mut Fields) -> Result<FitRequest, MessageError> {
    let step = fields.step.take().ok_or_else(|| missing("step", STEPS))?;
    let out_of_range = |message: String| Err(MessageError::new("out_of_range", message));
    match step.as_str() {
        "cancel" => return Ok(FitRequest::Cancel),
        "finish" => {
            let Some(name) = fields.name.take() else { return Ok(FitRequest::Finish { name: None }) };
            return match RoomName::new(&name) {
                Ok(name) => Ok(FitRequest::Finish { name: Some(name) }),
                Err(_) => out_of_range(format!("field name is {:?}, expected 1 to 64 characters of A-Z a-z 0-9 _ -", cut(&name))),
            };
        }
        _ => {}
    }
    let Some(step) = FitStep::from_name(&step) else { return out_of_range(format!("field step is {:?}, expected {STEPS}", cut(&step))) };
    let [least, most] = FIT_SECONDS;
    let seconds = fields.seconds.unwrap_or(DEFAULT_FIT_SECONDS);
    // A NaN is in no range.
    if !(least..=most).contains(&seconds) {
        return out_of_range(format!("field seconds is {seconds}, expected {least} to {most}"));
    }
    Ok(FitRequest::Measure { step, seconds })
}

fn check_settings(settings: Option<Settings>) -> Result<Settings, MessageError> {
    let settings = settings.unwrap_or_default();
    settings.check().map_err(|error| MessageError::new(error.code, error.message.replacen("field ", "field settings.", 1)))?;
    Ok(settings)
}

fn missing(field: &str, expected: &str) -> MessageError {
    MessageError::new("missing_field", format!("field {field} is missing, expected {expected}"))
}

/// The number of a session that there may have been, and its key.
fn check_resume(session: f64, key: Option<String>) -> Result<Resume, MessageError> {
    if let Some(key) = key.as_ref().filter(|key| key.len() > MAX_RESUME_KEY) {
        let message = format!("field resume_key has {} bytes, expected at most {MAX_RESUME_KEY}: the one that ready told", key.len());
        return Err(MessageError::new("out_of_range", message));
    }
    if session.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&session) {
        return Ok(Resume { session: session as u32, key });
    }
    Err(MessageError::new("out_of_range", format!("field resume is {session}, expected a whole number from 1 to {}", u32::MAX)))
}

/// A focal length in pixels that a lens can have before a picture of this size.
fn check_focal(focal: f64, image: Option<[f32; 2]>) -> Result<f32, MessageError> {
    let [least, most] = FOCAL_RANGE;
    let (narrowest, widest) = image.map_or((0.0, MAX_IMAGE as f32), |[width, _]| (width, width));
    let (shortest, longest) = (least * narrowest, most * widest);
    let pixels = focal as f32;
    if pixels > 0.0 && (shortest..=longest).contains(&pixels) {
        return Ok(pixels);
    }
    let of = image.map_or(String::new(), |[width, _]| format!(", {least} to {most} times the picture's width of {width}"));
    Err(MessageError::new("out_of_range", format!("field focal is {focal}, expected {shortest} to {longest} pixels{of}")))
}

fn check_layout(layout: LayoutField, features: Option<&BTreeSet<String>>) -> Result<Layout, MessageError> {
    let names = match layout {
        LayoutField::Name(name) => {
            return match name.as_str() {
                "ibug68" => Ok(Layout::Ibug68),
                "mediapipe478" => Ok(Layout::Mediapipe478),
                "openseeface66" => Ok(Layout::OpenSeeFace66),
                _ => Err(MessageError::new(
                    "unknown_layout",
                    format!(
                        "field layout is {:?}, expected \"ibug68\", \"mediapipe478\", \"openseeface66\" or a list of feature points",
                        name.chars().take(40).collect::<String>()
                    ),
                )),
            };
        }
        LayoutField::List(names) => names,
    };
    if names.is_empty() || names.len() > MAX_FEATURE_POINTS {
        return Err(MessageError::new(
            "unknown_layout",
            format!("field layout has {} names, expected 1 to {MAX_FEATURE_POINTS}", names.len()),
        ));
    }
    let mut seen = BTreeSet::new();
    for (i, name) in names.iter().enumerate() {
        let shown: String = name.chars().take(40).collect();
        if features.is_some_and(|features| !features.contains(name)) {
            return Err(MessageError::new(
                "unknown_layout",
                format!("field layout[{i}] is {shown:?}, which is no feature point of this character"),
            ));
        }
        if !seen.insert(name) {
            return Err(MessageError::new(
                "unknown_layout",
                format!("field layout[{i}] is {shown:?} a second time, expected each name once"),
            ));
        }
    }
    Ok(Layout::Named(names))
}

fn check_landmarks(fields: &mut Fields, layout: Option<&Layout>, data: &mut TrackingData) -> Result<(), MessageError> {
    let layout =
        layout.ok_or_else(|| MessageError::new("no_layout", "frame has landmarks, expected field layout in the hello to say which"))?;
    let (got, expected) = (fields.num_landmarks, layout.num_points());
    if got != expected {
        return Err(MessageError::new(
            "wrong_count",
            format!("field landmarks has {got} points, expected {expected} for layout {}", name_of(layout)),
        ));
    }
    if fields.has_confidence && fields.confidence.len() != expected {
        return Err(MessageError::new(
            "wrong_count",
            format!("field confidence has {} values, expected {expected}, one a landmark", fields.confidence.len()),
        ));
    }
    if !fields.has_confidence {
        fields.confidence.clear();
    }
    take_landmarks(fields, data);
    Ok(())
}

/// Hands the points read to a frame, in exchange for its old buffers.
fn take_landmarks(fields: &mut Fields, data: &mut TrackingData) {
    if !matches!(data, TrackingData::Landmarks { .. }) {
        *data = TrackingData::Landmarks { points: Vec::new(), confidence: Vec::new() };
    }
    if let TrackingData::Landmarks { points, confidence } = data {
        std::mem::swap(points, &mut fields.landmarks);
        std::mem::swap(confidence, &mut fields.confidence);
    }
}

fn name_of(layout: &Layout) -> &'static str {
    match layout {
        Layout::Ibug68 => "ibug68",
        Layout::Mediapipe478 => "mediapipe478",
        Layout::OpenSeeFace66 => "openseeface66",
        Layout::Named(_) => "of the hello's own list",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_one_line_whatever_it_repeats() {
        // Found by fuzzing: the name of the field came back as it was written.
        let text = r#"{"type":"profile","profile":{"rhytid_profile":1,"r\nges\u001b[31m":{}}}"#;
        let message = PublishReader::read_command(text).unwrap_err().message;
        assert!(message.contains("ges") && !message.contains(char::is_control), "{message:?}");
        let long = format!(r#"{{"type":"profile","profile":{{"rhytid_profile":1,"{}":{{}}}}}}"#, "é".repeat(100_000));
        assert!(PublishReader::read_command(&long).unwrap_err().message.chars().count() <= 2001);
    }
    use crate::testing::tiny_character;
    use glam::Vec3;

    const HELLO: &str =
        r#"{"type":"hello","version":1,"source":"me","fps":25,"layout":["brow_l","brow_r"],"image":[400,300],"extra":{"a":[1]}}"#;

    fn reader() -> (PublishReader, TrackingFrame) {
        (PublishReader::new(&tiny_character()), TrackingFrame::default())
    }

    fn after_hello() -> (PublishReader, TrackingFrame) {
        let (mut reader, mut frame) = reader();
        reader.read(HELLO, &mut frame).unwrap();
        (reader, frame)
    }

    #[test]
    fn every_kind_of_frame_is_read() {
        let (mut reader, mut frame) = after_hello();
        let mut read = |text: &str| {
            assert_eq!(reader.read(text, &mut frame), Ok(PublishMessage::Frame), "{text}");
            frame.clone()
        };
        let got = read(r#"{"t":0,"nested":{"landmarks":[1]},"landmarks":[[1,2],[3,4.5,-6e0]],"confidence":[1.001,0],"type":"frame"}"#);
        assert_eq!(got.data, TrackingData::Landmarks { points: vec![[1.0, 2.0, 0.0], [3.0, 4.5, -6.0]], confidence: vec![1.0, 0.0] });
        let got = read(r#"{"type":"frame","t":0.5,"landmarks":[[1,2],[3,4]]}"#);
        assert_eq!(
            (got.t, got.data),
            (0.5, TrackingData::Landmarks { points: vec![[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]], confidence: vec![] })
        );
        let got = read(
            r#"{"type":"frame","t":1,"weights":{"jawOpen":0.25,"BrowInnerUp":1.5,"_neutral":0.9,"eyeBlink_L":-0.1},"head":{"rotation":[0,0,0,2],"position":[0,0.1,9]}}"#,
        );
        let TrackingData::Weights { weights, head } = got.data else { panic!("not weights") };
        let of = |name| weights[crate::ArkitShape::from_name(name).unwrap().index()];
        assert_eq!((of("jawOpen"), of("browInnerUp"), of("eyeBlinkLeft"), of("tongueOut")), (0.25, 1.2, 0.0, 0.0));
        assert_eq!(head, Some(HeadPose { rotation: glam::Quat::IDENTITY, position: Vec3::new(0.0, 0.1, 0.3) }));
        // A shape not named again is 0, not what it was.
        let TrackingData::Weights { weights, head } = read(r#"{"type":"frame","t":1.5,"weights":{}}"#).data else { panic!("not weights") };
        assert_eq!((*weights, head), ([0.0; NUM_ARKIT_SHAPES], None));
        let got = read(r#"{"type":"frame","t":2,"bones":{"brow_r":[0,0.05,0.1]}}"#);
        assert_eq!(got.data, TrackingData::Bones { points: vec![(1, Vec3::new(0.0, 0.05, 0.1))], head: None });
        assert_eq!(read(r#"{"type":"frame","t":3,"face":false}"#).data, TrackingData::NoFace);
        assert_eq!(reader.read(r#"{"type":"calibrate"}"#, &mut frame), Ok(PublishMessage::Command(Command::Calibrate)));
    }

    #[test]
    fn each_bad_frame_is_refused_with_its_field_and_changes_nothing() {
        let (mut reader, mut frame) = after_hello();
        reader.read(r#"{"type":"frame","t":1,"landmarks":[[1,2],[3,4]]}"#, &mut frame).unwrap();
        let before = frame.clone();
        for (text, code, says) in [
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4]"#, "malformed_json", "EOF"),
            (r#"{"type":"frame","t":NaN,"landmarks":[[1,2],[3,4]]}"#, "malformed_json", "in field t"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[NaN,4]]}"#, "malformed_json", "in field landmarks"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[1e999,4]]}"#, "malformed_json", "number out of range"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4]]} x"#, "malformed_json", "trailing"),
            ("[1,2]", "wrong_type", "expected a JSON object"),
            (
                r#"{"type":"frame","t":2,"landmarks":{"0":[1,2]}}"#,
                "wrong_type",
                "field landmarks: invalid type: map, expected an array of [x, y]",
            ),
            (
                r#"{"type":"frame","t":2,"landmarks":[[1,null],[3,4]]}"#,
                "wrong_type",
                "field landmarks: invalid type: null, expected a number",
            ),
            (
                r#"{"type":"frame","t":"2","landmarks":[[1,2],[3,4]]}"#,
                "wrong_type",
                "field t: invalid type: string \"2\", expected a number (seconds",
            ),
            (r#"{"type":"frame","landmarks":[[1,2],[3,4]]}"#, "missing_field", "field t is missing"),
            (r#"{"type":"frame","t":2}"#, "missing_field", "landmarks, weights, bones, expressions or \"face\":false"),
            (r#"{"t":2,"face":false}"#, "missing_field", "field type"),
            (r#"{"type":"setting","t":2}"#, "unknown_type", "\"setting\""),
            (r#"{"type":"frame","t":1,"face":false}"#, "time_order", "field t is 1, expected more than the 1"),
            (r#"{"type":"frame","t":0.5,"face":false}"#, "time_order", "expected more than the 1"),
            (r#"{"type":"frame","t":-1,"face":false}"#, "out_of_range", "field t is -1"),
            (r#"{"type":"frame","t":1e300,"face":false}"#, "out_of_range", "field t"),
            (r#"{"type":"frame","t":9000000001,"face":false}"#, "out_of_range", "expected seconds from 0 to 9000000000"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2]]}"#, "wrong_count", "field landmarks has 1 points, expected 2"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4],[5,6]]}"#, "wrong_count", "has 3 points"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3]]}"#, "wrong_count", "landmarks[1] has 1 numbers"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4,5,6]]}"#, "wrong_count", "landmarks[1] has 4 numbers"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4e5]]}"#, "out_of_range", "landmarks[1] is"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4]],"confidence":[1]}"#, "wrong_count", "confidence has 1 values, expected 2"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4]],"confidence":[1,-3]}"#, "out_of_range", "confidence[1] is -3"),
            (r#"{"type":"frame","t":2,"landmarks":[[1,2],[3,4]],"weights":{}}"#, "ambiguous_frame", "expected one"),
            (r#"{"type":"frame","t":2,"weights":{"jawOpen":45}}"#, "out_of_range", "weights.jawOpen is 45, expected 0 to 1"),
            (r#"{"type":"frame","t":2,"weights":{"Jaw":0.5}}"#, "unknown_shape", "none is an ARKit shape"),
            (r#"{"type":"frame","t":2,"weights":[0.5]}"#, "wrong_type", "field weights"),
            (r#"{"type":"frame","t":2,"weights":{},"head":{"rotation":[0,0,0,0]}}"#, "out_of_range", "head.rotation"),
            (r#"{"type":"frame","t":2,"weights":{},"head":{"position":[0,0,100]}}"#, "out_of_range", "head.position"),
            (r#"{"type":"frame","t":2,"bones":{"tail":[0,0,0]}}"#, "unknown_bone", "bones.tail"),
            (
                r#"{"type":"frame","t":2,"bones":{"brow_l":[0,50,0]}}"#,
                "out_of_range",
                "bones.brow_l is [0.0, 50.0, 0.0], expected 3 numbers, metres",
            ),
            (r#"{"type":"frame","t":2,"bones":{"brow_l":[0,0]}}"#, "out_of_range", "bones.brow_l"),
            (HELLO, "repeated_hello", "one hello a session"),
        ] {
            let error = reader.read(text, &mut frame).expect_err(text);
            assert_eq!(error.code, code, "{text}: {error}");
            assert!(error.message.contains(says), "{text}: {error}");
            assert_eq!(frame, before, "{text}");
        }
        reader.read(r#"{"type":"frame","t":1.01,"face":false}"#, &mut frame).unwrap();
    }

    #[test]
    fn a_binary_frame_is_one_like_any_other() {
        let (mut reader, mut frame) = reader();
        let mut bytes = Vec::new();
        crate::tracking::encode_landmarks(1.0, &[[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]], &[], &mut bytes).unwrap();
        assert_eq!(reader.read_binary(&bytes, &mut frame).unwrap_err().code, "no_hello");
        reader.read(HELLO, &mut frame).unwrap();
        assert_eq!(reader.read_binary(&bytes, &mut frame), Ok(PublishMessage::Frame));
        let TrackingData::Landmarks { points, confidence } = &frame.data else { panic!("not landmarks") };
        assert!(frame.t == 1.0 && points.len() == 2 && (points[1][1] - 4.0).abs() < 1e-4 && confidence.is_empty());
        let before = frame.clone();
        assert_eq!(reader.read_binary(&bytes, &mut frame).unwrap_err().code, "time_order", "the clock is that of the JSON frames");
        bytes[4..12].copy_from_slice(&f64::NAN.to_le_bytes());
        assert_eq!(reader.read_binary(&bytes, &mut frame).unwrap_err().code, "out_of_range");
        assert_eq!(frame, before);
        let mut weights_only = PublishReader::for_any_character();
        weights_only.read(r#"{"type":"hello","version":1}"#, &mut frame).unwrap();
        assert_eq!(weights_only.read_binary(&bytes, &mut frame).unwrap_err().code, "no_layout");
    }

    #[test]
    fn expressions_come_with_anything_or_alone() {
        let mut character = tiny_character();
        character.zones = Some(crate::testing::one_zone(&["joy", "surprise"]));
        let mut reader = PublishReader::new(&character);
        let mut frame = TrackingFrame::default();
        reader.read(HELLO, &mut frame).unwrap();
        let mut given = |text: &str| {
            assert_eq!(reader.read(text, &mut frame), Ok(PublishMessage::Frame), "{text}");
            (frame.data.clone(), frame.expressions.map(|amounts| [amounts[0], amounts[1], amounts[2]]))
        };
        let (data, expressions) = given(r#"{"type":"frame","t":1,"landmarks":[[1,2],[3,4]],"expressions":{"surprise":0.8}}"#);
        assert!(matches!(data, TrackingData::Landmarks { .. }));
        assert_eq!(expressions, Some([0.0, 0.8, 0.0]));
        let (data, expressions) = given(r#"{"type":"frame","t":2,"expressions":{"joy":1.2,"surprise":0},"weights":{"jawOpen":1}}"#);
        assert!(matches!(data, TrackingData::Weights { .. }));
        assert_eq!(expressions, Some([1.2, 0.0, 0.0]));
        // Alone: the face at rest. An empty list is a face without any expression, not one that says nothing of them.
        assert_eq!(
            given(r#"{"type":"frame","t":3,"expressions":{}}"#),
            (TrackingData::Bones { points: vec![], head: None }, Some([0.0; 3]))
        );
        let (_, expressions) = given(r#"{"type":"frame","t":4,"bones":{},"head":{"rotation":[0,0,0,1]}}"#);
        assert_eq!(expressions, None, "what a frame does not say is not what the one before said");
        assert_eq!(given(r#"{"type":"frame","t":5,"expressions":{"joy":1},"face":false}"#), (TrackingData::NoFace, None));

        let before = frame.clone();
        for (text, code, says) in [
            (
                r#"{"type":"frame","t":6,"expressions":{"suprise":1}}"#,
                "unknown_expression",
                "field expressions.suprise is no expression of this character, expected joy, surprise",
            ),
            (r#"{"type":"frame","t":6,"expressions":{"joy":1.21}}"#, "out_of_range", "field expressions.joy is 1.21, expected 0 to 1.2"),
            (r#"{"type":"frame","t":6,"expressions":{"joy":-0.1}}"#, "out_of_range", "field expressions.joy is -0.1"),
            (r#"{"type":"frame","t":6,"expressions":{"joy":null}}"#, "wrong_type", "field expressions"),
            (r#"{"type":"frame","t":6,"expressions":[1]}"#, "wrong_type", "field expressions: invalid type: sequence"),
            (r#"{"type":"frame","t":6,"expressions":{"joy":NaN}}"#, "malformed_json", "in field expressions"),
        ] {
            let error = reader.read(text, &mut frame).expect_err(text);
            assert_eq!(error.code, code, "{text}: {error}");
            assert!(error.message.contains(says), "{text}: {error}");
            assert_eq!(frame, before, "{text}");
        }
    }

    #[test]
    fn expressions_for_a_character_without_any() {
        let (mut reader, mut frame) = after_hello();
        reader.read(r#"{"type":"frame","t":1,"landmarks":[[1,2],[3,4]],"expressions":{"joy":1}}"#, &mut frame).unwrap();
        assert_eq!(frame.expressions, None);
        let error = reader.read(r#"{"type":"frame","t":2,"expressions":{"joy":1}}"#, &mut frame).unwrap_err();
        assert_eq!(error.code, "no_expressions");
        // A sender does not know the character at the other end.
        let mut reader = PublishReader::for_any_character();
        reader.read(HELLO, &mut frame).unwrap();
        reader.read(r#"{"type":"frame","t":1,"expressions":{"awe":1}}"#, &mut frame).unwrap();
    }

    #[test]
    fn a_frame_taken_back_leaves_the_clock_as_it_was() {
        let (mut reader, mut frame) = after_hello();
        let mut read = |reader: &mut PublishReader, t: f64| reader.read(&format!(r#"{{"type":"frame","t":{t},"face":false}}"#), &mut frame);
        read(&mut reader, 1.0).unwrap();
        read(&mut reader, MAX_SECONDS).unwrap();
        reader.take_back();
        assert_eq!(read(&mut reader, 1.0).unwrap_err().code, "time_order", "the frame before still counts");
        read(&mut reader, 2.0).unwrap();
        // Also the first of all.
        let (mut reader, _) = after_hello();
        read(&mut reader, 5.0).unwrap();
        reader.take_back();
        read(&mut reader, 0.0).unwrap();
    }

    #[test]
    fn each_bad_hello_is_refused_with_its_field() {
        for (text, code, says) in [
            (r#"{"type":"frame","t":0,"face":false}"#, "no_hello", "first message must be"),
            (r#"{"type":"calibrate"}"#, "no_hello", "first message must be"),
            (r#"{"type":"hello"}"#, "missing_field", "field version is missing, expected 1"),
            (r#"{"type":"hello","version":2}"#, "unknown_version", "field version is 2, this server speaks 1"),
            (r#"{"type":"hello","version":"1"}"#, "wrong_type", "field version"),
            (r#"{"type":"hello","version":1,"layout":"dlib5"}"#, "unknown_layout", "\"dlib5\", expected \"ibug68\""),
            (r#"{"type":"hello","version":1,"layout":5}"#, "wrong_type", "expected the name of a layout"),
            (r#"{"type":"hello","version":1,"layout":[]}"#, "unknown_layout", "has 0 names"),
            (r#"{"type":"hello","version":1,"layout":["brow_l","toe"]}"#, "unknown_layout", "layout[1] is \"toe\""),
            (r#"{"type":"hello","version":1,"layout":["brow_l","brow_l"]}"#, "unknown_layout", "second time"),
            (r#"{"type":"hello","version":1,"layout":"ibug68"}"#, "missing_field", "field image"),
            (r#"{"type":"hello","version":1,"layout":"ibug68","image":[0,5]}"#, "out_of_range", "image[0]"),
            (r#"{"type":"hello","version":1,"layout":"ibug68","image":[5,5,5]}"#, "wrong_count", "image has 3 numbers"),
            (r#"{"type":"hello","version":1,"focal":-1}"#, "out_of_range", "focal is -1, expected 0 to 5000000 pixels"),
            (
                r#"{"type":"hello","version":1,"layout":"ibug68","focal":39.9,"image":[400,300]}"#,
                "out_of_range",
                "focal is 39.9, expected 40 to 20000 pixels, 0.1 to 50 times the picture's width of 400",
            ),
            (r#"{"type":"hello","version":1,"image":[400,300],"focal":20001}"#, "out_of_range", "focal is 20001, expected 40 to 20000"),
            (r#"{"type":"hello","version":1,"image":[400,300],"focal":1e300}"#, "out_of_range", "expected 40 to 20000"),
            (r#"{"type":"hello","version":1,"fps":0}"#, "out_of_range", "fps"),
            (
                r#"{"type":"hello","version":1,"takeover":"yes"}"#,
                "wrong_type",
                "field takeover: invalid type: string \"yes\", expected true or false",
            ),
            (r#"{"type":"hello","version":1,"keep_neutral":1}"#, "wrong_type", "field keep_neutral"),
            (r#"{"type":"hello","version":1,"resume":0}"#, "out_of_range", "field resume is 0, expected a whole number from 1"),
            (r#"{"type":"hello","version":1,"resume":1,"resume_key":7}"#, "wrong_type", "field resume_key"),
            (r#"{"type":"hello","version":1,"resume":1.5}"#, "out_of_range", "field resume is 1.5"),
            (r#"{"type":"hello","version":1,"resume":"last"}"#, "wrong_type", "field resume"),
            (r#"{"type":"hello","version":1,"slot":"a b"}"#, "out_of_range", "field slot is \"a b\", expected 1 to 64"),
            (r#"{"type":"hello","version":1,"slot":5}"#, "wrong_type", "field slot"),
            (
                r#"{"type":"hello","version":1,"priority":101}"#,
                "out_of_range",
                "field priority is 101, expected a whole number from 0 to 100",
            ),
            (r#"{"type":"hello","version":1,"priority":1.5}"#, "out_of_range", "field priority is 1.5"),
            (r#"{"type":"hello","version":1,"groups":["brows","ears"]}"#, "out_of_range", "field groups has \"ears\", expected brows"),
            (r#"{"type":"hello","version":1,"groups":[]}"#, "out_of_range", "field groups is empty"),
            (r#"{"type":"hello","version":1,"groups":"brows"}"#, "wrong_type", "field groups"),
        ] {
            let (mut reader, mut frame) = reader();
            let error = reader.read(text, &mut frame).expect_err(text);
            assert_eq!(error.code, code, "{text}: {error}");
            assert!(error.message.contains(says), "{text}: {error}");
        }
        let (mut reader, mut frame) = reader();
        let name = "é".repeat(500);
        let Ok(PublishMessage::Hello(hello)) = reader.read(&format!(r#"{{"type":"hello","version":1,"source":"{name}"}}"#), &mut frame)
        else {
            panic!("refused")
        };
        assert_eq!((hello.source.chars().count(), hello.layout, hello.takeover), (128, None, false));
    }

    #[test]
    fn key_of_a_session_is_short_and_may_be_missing() {
        let read = |key: &str| {
            let (mut reader, mut frame) = reader();
            let text = format!(r#"{{"type":"hello","version":1,"resume":7{key}}}"#);
            reader.read(&text, &mut frame).map(|message| {
                let PublishMessage::Hello(hello) = message else { panic!("{text}") };
                hello.resume.unwrap().key
            })
        };
        assert_eq!(read("").unwrap(), None);
        let longest = "k".repeat(MAX_RESUME_KEY);
        assert_eq!(read(&format!(r#","resume_key":"{longest}""#)).unwrap(), Some(longest.clone()));
        let error = read(&format!(r#","resume_key":"{longest}k""#)).unwrap_err();
        assert!(error.code == "out_of_range" && error.message.contains("resume_key has 65 bytes"), "{error}");
    }

    #[test]
    fn focal_lengths_that_lenses_have_are_taken() {
        for (focal, image) in [(40.0, "400,300"), (20_000.0, "400,300"), (0.1, "1,1"), (4e6, "1e5,1")] {
            let (mut reader, mut frame) = reader();
            let text = format!(
                r#"{{"type":"hello","version":1,"focal":{focal},"image":[{image}],"keep_neutral":true,"resume":7,"resume_key":"a1"}}"#
            );
            let Ok(PublishMessage::Hello(hello)) = reader.read(&text, &mut frame) else { panic!("{text} is refused") };
            assert_eq!(
                (hello.focal, hello.keep_neutral, hello.resume),
                (Some(focal as f32), true, Some(Resume { session: 7, key: Some("a1".into()) }))
            );
        }
    }

    #[test]
    fn too_many_points_are_counted_not_kept() {
        let (mut reader, mut frame) = after_hello();
        let points = vec!["[1,2]"; 40_000].join(",");
        let error = reader.read(&format!(r#"{{"type":"frame","t":2,"landmarks":[{points}]}}"#), &mut frame).unwrap_err();
        assert!(error.message.contains("has 40000 points"), "{error}");
        assert!(reader.fields.landmarks.capacity() <= 2 * MAX_FEATURE_POINTS);
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics(at in 0usize..120, byte in 0u8..128, cut in 0usize..120) {
            let (mut reader, mut frame) = after_hello();
            let good = r#"{"type":"frame","t":2,"bones":{"brow_l":[0,0.05,0.1]},"head":{"rotation":[0,0,0,1]},"face":true}"#;
            let mut bytes = good.as_bytes().to_vec();
            let last = bytes.len() - 1;
            bytes[at.min(last)] = byte;
            bytes.truncate(cut.max(1));
            if let Ok(text) = std::str::from_utf8(&bytes) {
                let _ = reader.read(text, &mut frame);
            }
        }
    }
}
