//! Live Link Face's recordings (CSV) as feeds. Columns are bound by the names in the header: their order is not that of the
//! datagrams, and programs differ in how many there are.
//!
//! ```text
//! Timecode,BlendShapeCount,EyeBlinkLeft,…,HeadYaw,HeadPitch,HeadRoll,…
//! 13:13:04:31.652,61,0.1236470118,…                  hours:minutes:seconds:frame.thousandths of a frame, 60 frames a second
//! ```

use super::table::{Rows, Table};
use super::{Refusal, livelink, weight};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, NUM_ARKIT_SHAPES};
use std::fmt::Write;

/// Frames a second that a timecode counts.
const RATE: f64 = 60.0;
/// Most columns.
const MOST_COLUMNS: usize = 256;
const DAY: f64 = 86_400.0;

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    Timecode,
    Count,
    Shape(usize),
    /// Yaw, pitch and roll of the head.
    Head(usize),
    Other,
}

/// Reads a recording as the lines of a feed: a hello, then one frame a row.
pub type LiveLinkCsv<R> = Table<R, Recording>;

/// What is known of the recording from the rows before.
#[derive(Default)]
pub struct Recording {
    /// Of the header; empty before it.
    columns: Vec<Column>,
    last_t: Option<f64>,
    /// Seconds of the days that have passed.
    days: f64,
}

impl Rows for Recording {
    /// A header of 70 names takes 1,200.
    const LONGEST: u64 = 16 << 10;

    fn take(&mut self, row: &str, text: &mut String) -> Result<(), String> {
        if self.columns.is_empty() {
            self.columns = columns(row)?;
            text.push_str("{\"type\":\"hello\",\"version\":1,\"source\":\"Live Link Face recording\",\"fps\":60}\n");
            return Ok(());
        }
        if row.is_empty() { Ok(()) } else { self.read_row(row, text) }
    }

    fn end(&self) -> Result<(), String> {
        if self.columns.is_empty() { Err("the recording is empty".into()) } else { Ok(()) }
    }
}

impl Recording {
    /// Writes the frame of a row; nothing where its time is not later than that of the row before.
    fn read_row(&mut self, row: &str, text: &mut String) -> Result<(), String> {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        let mut head = [0.0; 3];
        let (mut t, mut has_face, mut num_values) = (None, true, 0);
        let named = |refusal: Refusal, cell: &str| format!("{refusal}: {:?}", cell.chars().take(40).collect::<String>());
        for (cell, column) in row.split(',').zip(&self.columns) {
            let number = || cell.trim().parse::<f32>().map_err(|_| named(Refusal::Malformed, cell));
            match column {
                Column::Timecode => t = Some(seconds(cell.trim()).ok_or_else(|| named(Refusal::Malformed, cell))?),
                Column::Count => has_face = cell.trim() != "0",
                Column::Shape(index) => {
                    weights[*index] = weight(number()?).map_err(|refusal| named(refusal, cell))?;
                    num_values += 1;
                }
                Column::Head(axis) => head[*axis] = number()?,
                Column::Other => {}
            }
        }
        let mut t = t.ok_or("it has no time")? + self.days;
        if let Some(last) = self.last_t {
            // A take may go on past midnight.
            if t + DAY / 2.0 < last {
                self.days += DAY;
                t += DAY;
            }
            if t <= last {
                return Ok(());
            }
        }
        self.last_t = Some(t);
        let number = |text: &mut String, value: f32| {
            let _ = write!(text, "{value}");
        };
        let _ = write!(text, r#"{{"type":"frame","t":{t}"#);
        if !has_face || num_values == 0 {
            text.push_str(",\"face\":false}\n");
            return Ok(());
        }
        let num_expected = self.columns.iter().filter(|column| matches!(column, Column::Shape(_))).count();
        if num_values != num_expected {
            return Err(format!("it has {num_values} of {num_expected} weights"));
        }
        text.push_str(",\"weights\":{");
        for (i, (name, weight)) in ARKIT_NAMES.iter().zip(weights).enumerate() {
            let _ = write!(text, "{}\"{name}\":", if i == 0 { "" } else { "," });
            number(text, weight);
        }
        text.push('}');
        let [yaw, pitch, roll] = head;
        if let Some(rotation) = livelink::head_rotation(yaw, pitch, roll).map_err(|refusal| refusal.to_string())? {
            let [x, y, z, w] = rotation.to_array();
            let _ = write!(text, r#","head":{{"rotation":[{x},{y},{z},{w}],"position":[0,0,0]}}"#);
        }
        text.push_str("}\n");
        Ok(())
    }
}

fn columns(row: &str) -> Result<Vec<Column>, String> {
    let columns: Vec<Column> = row
        .split(',')
        .take(MOST_COLUMNS)
        .map(|name| match name.trim() {
            "Timecode" => Column::Timecode,
            "BlendshapeCount" | "BlendShapeCount" => Column::Count,
            "HeadYaw" => Column::Head(0),
            "HeadPitch" => Column::Head(1),
            "HeadRoll" => Column::Head(2),
            name => ArkitShape::from_name(name).map_or(Column::Other, |shape| Column::Shape(shape.index())),
        })
        .collect();
    let num_shapes = columns.iter().filter(|column| matches!(column, Column::Shape(_))).count();
    if !columns.contains(&Column::Timecode) || num_shapes == 0 {
        return Err("it is no header of Live Link Face, expected Timecode,BlendShapeCount,EyeBlinkLeft,…".into());
    }
    Ok(columns)
}

/// `HH:MM:SS:FF.mmm` as seconds.
fn seconds(timecode: &str) -> Option<f64> {
    let mut parts = timecode.split(':');
    let mut whole = |most: u32| parts.next()?.parse::<u32>().ok().filter(|part| *part <= most);
    let (hours, minutes, seconds) = (whole(48)?, whole(59)?, whole(59)?);
    let frame: f64 = parts.next()?.parse().ok()?;
    if parts.next().is_some() || !(0.0..RATE).contains(&frame) {
        return None;
    }
    // A recording's rows are whole thousandths of a frame apart: no noise behind them.
    let t = f64::from(hours * 3600 + minutes * 60 + seconds) + frame / RATE;
    Some((t * 1e6).round() / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::feed::{Feed, FeedItem};
    use rhytid_shared::{TrackingData, TrackingFrame};
    use std::io::Read;

    fn lines(text: &str) -> Result<String, String> {
        let mut out = String::new();
        LiveLinkCsv::new(text.as_bytes()).read_to_string(&mut out).map_err(|error| error.to_string())?;
        Ok(out)
    }

    #[test]
    fn columns_are_bound_by_name_and_time_goes_past_midnight() {
        let text = "Timecode,BlendshapeCount,JawRight,JawLeft,Anger,HeadYaw,HeadPitch,HeadRoll\r\n\
                    23:59:59:59.500,61,0.25,0.5,9,0.1,0,0\r\n23:59:59:59.500,61,0.3,0.5,9,0,0,0\r\n00:00:00:01.000,61,0.75,0,9,0,0,0\n\
                    00:00:00:02.000,0\n\n";
        let feed = lines(text).unwrap();
        let mut feed = Feed::new_for_any_character(feed.as_bytes(), "x".into()).unwrap();
        let mut frame = TrackingFrame::default();
        let mut frames = Vec::new();
        while let Some(FeedItem::Frame) = feed.next_frame(&mut frame).unwrap() {
            frames.push(frame.clone());
        }
        assert_eq!(frames.len(), 3, "the row of the same time is left out");
        assert!((frames[0].t - 86_399.991_667).abs() < 1e-5 && (frames[1].t - 86_400.016_667).abs() < 1e-5, "{frames:?}");
        let TrackingData::Weights { weights, head } = &frames[0].data else { panic!("weights") };
        let of = |name| weights[ArkitShape::from_name(name).unwrap().index()];
        assert_eq!((of("jawRight"), of("jawLeft"), head.is_some()), (0.25, 0.5, true));
        assert_eq!(frames[2].data, TrackingData::NoFace);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        for (text, expected) in [
            ("", "line 1: the recording is empty"),
            ("a,b\n", "line 1: it is no header"),
            ("Timecode,JawOpen\n1:2:3,0.5\n", "line 2: its text is malformed: \"1:2:3\""),
            ("Timecode,JawOpen\n1:2:3:60,0.5\n", "line 2: its text is malformed"),
            ("Timecode,JawOpen\n1:2:3:4,x\n", "line 2: its text is malformed: \"x\""),
            ("Timecode,JawOpen\n1:2:3:4,50\n", "line 2: a number in it is out of range: \"50\""),
            ("Timecode,JawOpen,TongueOut\n1:2:3:4,0.5\n", "line 2: it has 1 of 2 weights"),
        ] {
            let error = lines(text).unwrap_err();
            assert!(error.starts_with(expected), "{error} / {expected}");
        }
        let long = format!("Timecode,JawOpen\n{}\n", "1".repeat(20_000));
        assert!(lines(&long).unwrap_err().contains("longer than"));
    }

    #[test]
    #[ignore = "needs a recording of Live Link Face, which RHYTID_LIVELINK_CSV names"]
    fn a_real_recording_is_read_whole() {
        let path = std::env::var_os("RHYTID_LIVELINK_CSV").expect("RHYTID_LIVELINK_CSV names a recording");
        let mut feed = Feed::open_for_any_character(std::path::Path::new(&path)).unwrap();
        let (mut frame, mut count) = (TrackingFrame::default(), 0);
        while feed.next_frame(&mut frame).unwrap().is_some() {
            count += 1;
        }
        assert!(count > 1000, "{count} frames");
    }
}
