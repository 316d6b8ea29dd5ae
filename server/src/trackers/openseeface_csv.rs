//! OpenSeeFace's log (`facetracker.py --log-data FILE`, CSV) as a feed, as its source writes it from the first version that logs (2020)
//! to the present one. Its header names 66 landmarks and 66 points in space while its rows hold 68 and 70 (pupils, centres of the
//! eyes), so columns behind the first landmark are bound by their place; 14 features behind them came later.
//!
//! ```text
//! Frame,Time,Width,Height,FPS,Face,FaceID,RightOpen,LeftOpen,AverageConfidence,Success3D,PnPError,          12 columns
//! RotationQuat.X…W,Euler.X…Z,RVec.X…Z,TVec.X…Z,                                                             13, some in brackets
//! Landmark[0].X,Landmark[0].Y,Landmark[0].Confidence,…,Point3D[0].X,…,eye_l,…,mouth_wide
//! 12,1700000000.25,640,480,24,0,0,0.9,0.8,0.7,True,1.5,…     Unix seconds; X to the right, Y down, pixels
//! ```
//! Lines end in `\r\n`, on Windows in `\r\r\n`: it writes the former to a file of text.
//! Of several faces the first of each camera frame is taken; where none is logged for a while, the feed says that there is no face.

use super::openseeface::NUM_POINTS;
use super::table::{Rows, Table};
use std::fmt::Write;

/// What its header begins with.
pub const BEGINNING: &str = "Frame,Time,Width,Height,";
/// Column of the first landmark.
const FIRST_LANDMARK: usize = 25;
/// Rows farther apart than this, seconds, have no face between them: the tracker logs every camera frame that has one.
const LONGEST_STEP: f64 = 0.5;
/// Largest side of a picture and farthest landmark, pixels.
const FARTHEST: f64 = 1e5;

/// Reads a log as the lines of a feed: a hello, then one frame a row.
pub type OpenSeeFaceCsv<R> = Table<R, Log>;

/// What is known of the log from the rows before.
#[derive(Default)]
pub struct Log {
    has_header: bool,
    /// Width and height, pixels.
    image: Option<[f64; 2]>,
    last_t: Option<f64>,
}

impl Rows for Log {
    /// 453 numbers of 24 digits take 11,300.
    const LONGEST: u64 = 64 << 10;

    fn take(&mut self, row: &str, text: &mut String) -> Result<(), String> {
        if !self.has_header {
            if !row.starts_with(BEGINNING) || row.split(',').nth(FIRST_LANDMARK) != Some("Landmark[0].X") {
                return Err(format!("it is no header of OpenSeeFace, expected {BEGINNING}…"));
            }
            self.has_header = true;
        } else if !row.is_empty() {
            self.write(&Row::read(row)?, text);
        }
        Ok(())
    }

    fn end(&self) -> Result<(), String> {
        self.image.map(|_| ()).ok_or_else(|| "the log has no rows".into())
    }
}

impl Log {
    /// Writes what a row adds to the feed.
    fn write(&mut self, row: &Row, text: &mut String) {
        // Another face of the same picture, or a clock that was set back.
        if row.face != 0 || self.last_t.is_some_and(|last| row.t <= last) {
            return;
        }
        if self.image.is_none() {
            let [width, height] = *self.image.insert(row.image);
            // Its own camera has a focal length of the picture's width.
            let _ = writeln!(
                text,
                r#"{{"type":"hello","version":1,"source":"OpenSeeFace log","layout":"openseeface66","image":[{width},{height}],"focal":{width}}}"#
            );
        }
        if let Some(last) = self.last_t.filter(|last| row.t - last > LONGEST_STEP) {
            let _ = writeln!(text, r#"{{"type":"frame","t":{},"face":false}}"#, last + LONGEST_STEP / 2.0);
        }
        self.last_t = Some(row.t);
        let _ = write!(text, r#"{{"type":"frame","t":{},"landmarks":["#, row.t);
        for (i, [x, y, _]) in row.landmarks.iter().enumerate() {
            let _ = write!(text, "{}[{x},{y}]", if i == 0 { "" } else { "," });
        }
        text.push_str("],\"confidence\":[");
        for (i, [.., confidence]) in row.landmarks.iter().enumerate() {
            let _ = write!(text, "{}{confidence}", if i == 0 { "" } else { "," });
        }
        text.push_str("]}\n");
    }
}

/// A row that has been checked.
struct Row {
    t: f64,
    image: [f64; 2],
    /// Counts the faces of one picture.
    face: u32,
    /// X, Y and confidence.
    landmarks: [[f64; 3]; NUM_POINTS],
}

impl Row {
    fn read(row: &str) -> Result<Self, String> {
        let mut cells = row.split(',');
        let mut number = |name: &str, range: std::ops::RangeInclusive<f64>| {
            let cell = cells.next().ok_or_else(|| format!("it ends before {name}"))?.trim();
            let shown = || cell.chars().take(40).collect::<String>();
            let value = cell.parse::<f64>().ok().filter(|value| range.contains(value));
            value.ok_or_else(|| format!("{name} is {:?}, expected a number from {} to {}", shown(), range.start(), range.end()))
        };
        number("Frame", 0.0..=1e15)?;
        let t = number("Time", 0.0..=rhytid_shared::limits::MAX_SECONDS)?;
        let image = [number("Width", 1.0..=FARTHEST)?, number("Height", 1.0..=FARTHEST)?];
        number("FPS", -1e6..=1e6)?;
        let face = number("Face", 0.0..=1000.0)? as u32;
        // The tracker's own fit, some of it in brackets.
        let mut cells = row.split(',').skip(FIRST_LANDMARK);
        let mut landmarks = [[0.0; 3]; NUM_POINTS];
        for (i, landmark) in landmarks.iter_mut().enumerate() {
            for (value, most) in landmark.iter_mut().zip([FARTHEST, FARTHEST, 1e3]) {
                let cell = cells.next().ok_or_else(|| format!("it ends before landmark {i}"))?.trim();
                let read = cell.parse::<f64>().ok().filter(|read| read.is_nan() || read.abs() <= most);
                *value =
                    read.ok_or_else(|| format!("landmark {i} has {:?}, expected a number", cell.chars().take(40).collect::<String>()))?;
            }
            // A landmark that the model did not find is 0, 0 without confidence in later versions, and no number in earlier ones.
            if landmark.iter().any(|value| value.is_nan()) {
                *landmark = [0.0; 3];
            }
            landmark[2] = landmark[2].clamp(0.0, 1.0);
        }
        Ok(Self { t, image, face, landmarks })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::feed::{Feed, FeedItem};
    use rhytid_shared::{TrackingData, TrackingFrame};
    use std::io::Read;

    /// What ends a line that the program writes on Windows.
    const END: &str = "\r\r\n";
    const FEATURES: [&str; 14] = [
        "eye_l",
        "eye_r",
        "eyebrow_steepness_l",
        "eyebrow_updown_l",
        "eyebrow_quirk_l",
        "eyebrow_steepness_r",
        "eyebrow_updown_r",
        "eyebrow_quirk_r",
        "mouth_corner_updown_l",
        "mouth_corner_inout_l",
        "mouth_corner_updown_r",
        "mouth_corner_inout_r",
        "mouth_open",
        "mouth_wide",
    ];

    fn header() -> String {
        let named =
            |kind: &str, last: &str| -> String { (0..66).map(|i| format!(",{kind}[{i}].X,{kind}[{i}].Y,{kind}[{i}].{last}")).collect() };
        let fit = "RotationQuat.X,RotationQuat.Y,RotationQuat.Z,RotationQuat.W,Euler.X,Euler.Y,Euler.Z,RVec.X,RVec.Y,RVec.Z";
        let first = "Frame,Time,Width,Height,FPS,Face,FaceID,RightOpen,LeftOpen,AverageConfidence,Success3D,PnPError";
        let (landmarks, points) = (named("Landmark", "Confidence"), named("Point3D", "Z"));
        format!("{first},{fit},TVec.X,TVec.Y,TVec.Z{landmarks}{points},{}{END}", FEATURES.join(","))
    }

    /// What stands between the number of the face and its landmarks, where its fit in space succeeded and where it did not.
    const FIT: &str = "1.0,0.9,0.81234,True,1.2e-05,0.0,-0.7,0.7,1e-07,179.5,-1.0,90.0,[0.1],[-0.2],[0.3],[1.0],[2.0],[3.0]";
    const NO_FIT: &str = "1,1,0.4,False,99999.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0";

    /// As the program writes it: 68 landmarks, 70 points, 14 features.
    fn row(t: f64, face: u32, offset: f64) -> String {
        row_with(t, face, FIT, |i| format!("{:?},{}.0,0.5", 100.0 + f64::from(i) + offset, 50 + i))
    }

    fn row_with(t: f64, face: u32, fit: &str, landmark: impl Fn(u32) -> String) -> String {
        let landmarks: String = (0..68).map(|i| format!(",{}", landmark(i))).collect();
        format!("1,{t},640,480,30,{face},{face},{fit}{landmarks}{}{}{END}", ",0.0,-0.0,-0.0".repeat(70), ",0".repeat(14))
    }

    #[test]
    fn rows_become_frames_and_gaps_faces_that_are_lost() {
        let text = header() + &row(10.0, 0, 0.0) + &row(10.0, 1, 9.0) + &row(10.04, 0, 1.0) + END + &row(12.0, 0, 2.0);
        let lines = std::io::BufReader::new(OpenSeeFaceCsv::new(text.as_bytes()));
        let mut feed = Feed::new_for_any_character(lines, "log".into()).unwrap();
        assert_eq!((feed.hello.image, feed.hello.focal), (Some([640.0, 480.0]), Some(640.0)));
        let (mut frame, mut seen) = (TrackingFrame::default(), Vec::new());
        while let Some(FeedItem::Frame) = feed.next_frame(&mut frame).unwrap() {
            seen.push((
                frame.t,
                match &frame.data {
                    TrackingData::Landmarks { points, confidence } => {
                        assert_eq!((points.len(), confidence.len(), confidence[65]), (66, 66, 0.5));
                        Some(points[65])
                    }
                    _ => None,
                },
            ));
        }
        assert_eq!(seen[..2], [(10.0, Some([165.0, 115.0, 0.0])), (10.04, Some([166.0, 115.0, 0.0]))]);
        assert!(seen.len() == 4 && seen[2].1.is_none() && (10.04..12.0).contains(&seen[2].0) && seen[3].0 == 12.0, "{seen:?}");
    }

    #[test]
    fn a_row_of_every_kind_has_its_landmarks() {
        assert_eq!((header().split(',').count(), row(1.0, 0, 0.0).split(',').count()), (25 + 66 * 6 + 14, 25 + 68 * 3 + 70 * 3 + 14));
        let missing = |i: u32| if i == 7 { "nan,nan,0.9".into() } else { format!("{i}.5,7e1,1.25") };
        let early = row_with(3.0, 0, FIT, |i| format!("{i},2,0.1")).replace(END, "\r\n");
        let early = early.split_once(",0.0,-0.0").map(|(landmarks, _)| format!("{landmarks},0.0\n")).unwrap();
        let text = header() + &row_with(1.0, 0, NO_FIT, |i| format!("{i}.5,7e1,1.25")) + &row_with(2.0, 0, FIT, missing) + &early;
        let lines = std::io::BufReader::new(OpenSeeFaceCsv::new(text.as_bytes()));
        let mut feed = Feed::new_for_any_character(lines, "log".into()).unwrap();
        let (mut frame, mut seen) = (TrackingFrame::default(), Vec::new());
        while feed.next_frame(&mut frame).unwrap().is_some() {
            if let TrackingData::Landmarks { points, confidence } = &frame.data {
                seen.push([7, 65].map(|i| (points[i], confidence[i])));
            }
        }
        let at = |x: f32, y: f32, confidence: f32| ([x, y, 0.0], confidence);
        assert_eq!(seen[0], [at(7.5, 70.0, 1.0), at(65.5, 70.0, 1.0)], "without a fit in space");
        assert_eq!(seen[1], [at(0.0, 0.0, 0.0), at(65.5, 70.0, 1.0)], "a landmark that was not found");
        assert_eq!(seen[2], [at(7.0, 2.0, 0.1), at(65.0, 2.0, 0.1)]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let says = |text: &str| OpenSeeFaceCsv::new(text.as_bytes()).read_to_string(&mut String::new()).unwrap_err().to_string();
        assert!(says("").contains("the log has no rows"));
        assert!(says("Frame,Time,Width,Height,x\n").contains("it is no header of OpenSeeFace"));
        assert!(says(&(header() + "1,2,640\n")).contains("line 2: it ends before Height"), "{}", says(&(header() + "1,2,640\n")));
        assert!(says(&(header() + &row(1.0, 0, 0.0).replace("480", "NaN"))).contains("Height is \"NaN\""));
        assert!(says(&(header() + &row(1.0, 0, 1e9))).contains("landmark 0 has"));
        assert!(says(&(header() + &"9".repeat(70_000))).contains("longer than"));
    }
}
