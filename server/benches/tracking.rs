//! What reading one frame of 478 points costs, as JSON and in the binary form. Prints the sizes.

#![allow(missing_docs, reason = "criterion's macros make functions without docs")]

use criterion::{Criterion, criterion_group, criterion_main};
use rhytid_shared::{PublishReader, TrackingFrame, encode_landmarks};
use std::fmt::Write;
use std::hint::black_box;

const HELLO: &str = r#"{"type":"hello","version":1,"layout":"mediapipe478","image":[1280,720]}"#;

fn read(criterion: &mut Criterion) {
    // Digits as trackers write them.
    let points: Vec<[f32; 3]> = (0..478_u32)
        .map(|i| [i * 7919 % 1280, i * 6007 % 720, i * 31 % 90].map(|value| value as f32 + 0.123_456_7 * (i % 7) as f32))
        .collect();
    let confidence = vec![0.875_f32; points.len()];
    let mut text = String::from(r#"{"type":"frame","t":1.04,"landmarks":["#);
    for (i, [x, y, z]) in points.iter().enumerate() {
        let comma = if i == 0 { "" } else { "," };
        let _ = write!(text, "{comma}[{},{},{}]", f64::from(*x), f64::from(*y), f64::from(*z));
    }
    let confidences: Vec<String> = confidence.iter().map(f32::to_string).collect();
    let _ = write!(text, r#"],"confidence":[{}]}}"#, confidences.join(","));
    let mut bytes = Vec::new();
    encode_landmarks(1.04, &points, &confidence, &mut bytes).expect("a frame like any other");
    println!("JSON {} bytes, binary {} bytes", text.len(), bytes.len());

    let mut frame = TrackingFrame::default();
    let mut reader = PublishReader::for_any_character();
    reader.read(HELLO, &mut frame).expect("a good hello");
    let mut group = criterion.benchmark_group("read 478 points");
    // The same frame again and again: its time is taken back each time.
    group.bench_function("json", |bencher| {
        bencher.iter(|| {
            black_box(reader.read(&text, &mut frame)).expect("a good frame");
            reader.take_back();
        });
    });
    group.bench_function("binary", |bencher| {
        bencher.iter(|| {
            black_box(reader.read_binary(&bytes, &mut frame)).expect("a good frame");
            reader.take_back();
        });
    });
    group.finish();
}

criterion_group!(benches, read);
criterion_main!(benches);
