//! Recordings are small, they can be entered anywhere, and no bytes break their reader.

use crate::fixture::{noise, resampled, write_packets};
use crate::server::Folder;
use rhytid_server::load_character;
use rhytid_server::recording::{Faces, Recording, recover, verify};
use rhytid_shared::TrackingFrame;
use std::time::{Duration, Instant};

#[test]
fn a_minute_of_packets_at_60_hz_takes_less_than_200_kib() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 60.0);
    let path = folder.path("size.mcap");
    write_packets(&path, &character, &hello, &frames);
    let seconds = frames.last().unwrap().t - frames[0].t;
    let bytes = std::fs::metadata(&path).unwrap().len() as f64;
    let a_minute = bytes / 1024.0 * 60.0 / seconds;
    println!("{} packets: {a_minute:.0} KiB a minute with expression weights", frames.len());
    assert!(a_minute <= 200.0, "{a_minute} KiB");
}

#[test]
fn an_hour_can_be_entered_anywhere_within_100_ms() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 12.5);
    // The same twenty seconds again and again, on one clock.
    let length = frames.last().unwrap().t - frames[0].t + 0.08;
    let hour: Vec<TrackingFrame> = (0..180)
        .flat_map(|round| frames.iter().map(move |frame| TrackingFrame { t: frame.t + round as f64 * length, ..frame.clone() }))
        .collect();
    let path = folder.path("hour.mcap");
    let shown = write_packets(&path, &character, &hello, &hour);
    let opened = Instant::now();
    let recording = Recording::open(&path).unwrap();
    let opening = opened.elapsed();
    assert!(recording.seconds() > 3500.0, "{}", recording.seconds());
    let mut faces = Faces::new(recording);
    let mut worst = Duration::ZERO;
    for i in 0..40 {
        let to = noise(i) * 3500.0;
        let start = Instant::now();
        let found = faces.seek(to).unwrap().unwrap();
        worst = worst.max(start.elapsed());
        assert!(found.at <= to && to - found.at < 0.1, "{to} gave {found:?}");
        // The face that stands there, and no other.
        assert_eq!(faces.frame().captured_at_micros, shown[faces.frame().seq as usize].captured_at_micros);
    }
    println!("opened in {opening:?}, worst of 40 seeks {worst:?}, {} bytes", std::fs::metadata(&path).unwrap().len());
    assert!(opening + worst < Duration::from_millis(100), "opened in {opening:?}, worst seek {worst:?}");
}

#[test]
fn no_bytes_break_the_reader() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 10.0);
    let path = folder.path("whole.mcap");
    write_packets(&path, &character, &hello, &frames[..40]);
    let whole = std::fs::read(&path).unwrap();
    let broken = folder.path("broken.mcap");
    let (mut num_opened, mut num_refused) = (0, 0);
    let mut look = |bytes: &[u8]| {
        std::fs::write(&broken, bytes).unwrap();
        match Recording::open(&broken) {
            Ok(recording) => {
                num_opened += 1;
                let mut faces = Faces::new(recording);
                while let Ok(Some(_)) = faces.advance() {}
                let _ = faces.seek(2.0);
                let _ = verify(&mut Recording::open(&broken).unwrap(), &character);
                let _ = recover(&broken, Some(&folder.path("out.mcap")));
                let _ = std::fs::remove_file(folder.path("out.mcap"));
            }
            Err(error) => {
                num_refused += 1;
                assert!(!error.to_string().contains('\n'), "{error}");
            }
        }
    };
    for i in 0..120 {
        look(&whole[..whole.len() * i / 120]);
    }
    for i in 0..400u64 {
        let mut bytes = whole.clone();
        for k in 0..1 + i % 4 {
            let at = (noise(i * 10 + k) * bytes.len() as f64) as usize;
            // Lengths are where it hurts.
            bytes[at] = if i % 2 == 0 { 0xFF } else { (noise(i * 77 + k) * 256.0) as u8 };
        }
        look(&bytes);
    }
    for bytes in [&b""[..], b"\x89MCAP0\r\n", b"no recording at all", &whole[..9]] {
        look(bytes);
    }
    println!("{num_opened} opened, {num_refused} refused");
    assert!(num_opened > 50 && num_refused > 10);
}
