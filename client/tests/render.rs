//! `render` and `still` as a user runs them: the real program, a feed file, tiny pictures. Where there is no adapter they show
//! as ignored.

use image::AnimationDecoder;
use libtest_mimic::{Arguments, Failed, Trial};
use rhytid_server::feed::Feed;
use rhytid_server::pipeline::Pipeline;
use rhytid_server::recording::{RecordingWriter, SessionEvent};
use rhytid_server::solve::SolveConfig;
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::ViewHello;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, TrackingFrame};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn main() {
    let has_adapter = has_adapter();
    let drawn = |name: &str, test: fn() -> Result<(), Failed>| Trial::test(name, test).with_ignored_flag(!has_adapter);
    let trials = vec![
        drawn("every_tenth_frame_is_named_by_its_index", every_tenth_frame_is_named_by_its_index),
        drawn("limit_ends_after_so_many_pictures", limit_ends_after_so_many_pictures),
        drawn("a_recording_is_drawn_as_its_packets_went_out", a_recording_is_drawn_as_its_packets_went_out),
        drawn("animations_show_every_picture_in_its_time", animations_show_every_picture_in_its_time),
        drawn("views_show_different_things", views_show_different_things),
        drawn("two_processes_draw_the_same_bytes", two_processes_draw_the_same_bytes),
        drawn("a_neutral_is_kept_and_used_again", a_neutral_is_kept_and_used_again),
        drawn("what_is_no_neutral_for_the_feed_is_refused", what_is_no_neutral_for_the_feed_is_refused),
        drawn("bad_line_ends_it_and_is_named", bad_line_ends_it_and_is_named),
        drawn("still_draws_the_pose_it_is_asked_for", still_draws_the_pose_it_is_asked_for),
        drawn("unknown_names_are_refused_with_those_there_are", unknown_names_are_refused_with_those_there_are),
        Trial::test("numbers_out_of_range_are_refused", numbers_out_of_range_are_refused),
    ];
    libtest_mimic::run(&Arguments::from_args(), trials).exit();
}

fn has_adapter() -> bool {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    pollster::block_on(wgpu::util::initialize_adapter_from_env_or_default(&instance, None)).is_ok()
}

/// A folder of this test's own, emptied.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("render").join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).expect("the build's own folder can be written");
    path
}

/// A feed in `folder` of 21 frames whose brows rise from rest, a frame a line after the hello; `line` (from 1) replaced.
fn feed(folder: &Path, line: Option<(usize, &str)>) -> PathBuf {
    let mut lines = vec![r#"{"type":"hello","version":1,"source":"test","fps":25}"#.to_owned()];
    lines.extend((0..21).map(|i| {
        let (t, weight) = (f64::from(i) * 0.04, f64::from(i) / 20.0);
        format!(r#"{{"type":"frame","t":{t:.2},"weights":{{"browInnerUp":{weight},"browOuterUpLeft":{weight}}}}}"#)
    }));
    if let Some((line, text)) = line {
        text.clone_into(&mut lines[line - 1]);
    }
    let text = lines.iter().fold(String::new(), |mut text, line| {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{line}");
        text
    });
    let path = folder.join("feed.jsonl");
    std::fs::write(&path, text).expect("the build's own folder can be written");
    path
}

fn client(args: &[&str]) -> std::io::Result<Output> {
    // Where a machine has none, the software driver says so on standard error, among what the program says.
    Command::new(env!("CARGO_BIN_EXE_rhytid-client")).args(args).env("XDG_RUNTIME_DIR", env!("CARGO_TARGET_TMPDIR")).output()
}

fn render(feed: &Path, out: &Path, more: &[&str]) -> std::io::Result<Output> {
    let (feed, out) = (feed.display().to_string(), out.display().to_string());
    client(&[&["render", &feed, "--out", &out, "--size", "64x64"], more].concat())
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn check(output: &Output) -> Result<(), Failed> {
    if output.status.success() { Ok(()) } else { Err(format!("{}: {}", output.status, stderr(output)).into()) }
}

/// Names of the pictures in `folder`, sorted.
fn pictures(folder: &Path) -> std::io::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        names.push(entry?.file_name().to_string_lossy().into_owned());
    }
    names.retain(|name| name.ends_with(".png"));
    names.sort();
    Ok(names)
}

fn every_tenth_frame_is_named_by_its_index() -> Result<(), Failed> {
    let out = folder("every");
    let output = render(&feed(&out, None), &out, &["--every", "10"])?;
    check(&output)?;
    assert_eq!(pictures(&out)?, ["00000.png", "00010.png", "00020.png"]);
    assert_eq!(String::from_utf8_lossy(&output.stdout), format!("3 pictures in {}\n", out.display()));
    for name in pictures(&out)? {
        let picture = image::open(out.join(&name))?;
        assert_eq!((picture.width(), picture.height()), (64, 64), "{name}");
    }
    let (first, last) = (std::fs::read(out.join("00000.png"))?, std::fs::read(out.join("00020.png"))?);
    assert!(first != last, "the brows have risen");
    Ok(())
}

fn limit_ends_after_so_many_pictures() -> Result<(), Failed> {
    let out = folder("limit");
    check(&render(&feed(&out, None), &out, &["--every", "10", "--limit", "2"])?)?;
    assert_eq!(pictures(&out)?, ["00000.png", "00010.png"]);
    Ok(())
}

/// A recording of what `feed` gives, beside it.
fn recording(feed: &Path) -> Result<PathBuf, Failed> {
    let path = feed.with_extension("mcap");
    let character = std::sync::Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB)?);
    let mut feed = Feed::open(feed, &character)?;
    let mut pipeline = Pipeline::new(character.clone(), &SolveConfig::default(), &feed.hello, 1)?;
    let mut writer = RecordingWriter::to(std::fs::File::create(&path)?, PacketLayout::from(&*character))?;
    let character = Box::new(ViewHello::new("test", &character, String::new()).character);
    writer.event(0, &SessionEvent::Recording { version: 1, room: "test".into(), server: "test".into(), character, clock: 0 })?;
    let (mut frame, mut packet) = (TrackingFrame::default(), Vec::new());
    while feed.next_frame(&mut frame)?.is_some() {
        pipeline.frame(&frame, &mut packet)?;
        writer.packet((frame.t * 1e9) as u64, packet.clone().into());
    }
    writer.finish()?;
    Ok(path)
}

fn a_recording_is_drawn_as_its_packets_went_out() -> Result<(), Failed> {
    let out = folder("recording");
    let feed = feed(&out, None);
    check(&render(&feed, &out.join("solved"), &["--every", "10"])?)?;
    check(&render(&recording(&feed)?, &out.join("recorded"), &["--every", "10"])?)?;
    assert_eq!(pictures(&out.join("recorded"))?, ["00000.png", "00010.png", "00020.png"]);
    let open = |run: &str, name: &str| image::open(out.join(run).join(name)).map(|picture| picture.to_rgb8());
    let mean = |a: &image::RgbImage, b: &image::RgbImage| {
        let sum: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        sum as f64 / a.as_raw().len() as f64
    };
    for name in pictures(&out.join("solved"))? {
        let off = mean(&open("solved", &name)?, &open("recorded", &name)?);
        assert!(off < 0.2, "{name} is off by {off} codes: packets round");
    }
    assert!(mean(&open("recorded", "00000.png")?, &open("recorded", "00020.png")?) > 0.4, "the brows rise");
    // A neutral changes nothing in packets.
    let refused = render(&out.join("feed.mcap"), &out.join("x"), &["--save-calibration", "neutral.json"])?;
    assert!(!refused.status.success() && stderr(&refused).contains("drawn as they are"), "{}", stderr(&refused));
    Ok(())
}

fn animations_show_every_picture_in_its_time() -> Result<(), Failed> {
    let out = folder("animations");
    let take = recording(&feed(&out, None))?.display().to_string();
    let [gif, apng, mp4] = ["face.gif", "face.png", "face.mp4"].map(|name| out.join(name).display().to_string());
    check(&client(&["render", &take, "--gif", &gif, "--apng", &apng, "--every", "5", "--size", "64x64"])?)?;
    let read = |path: &str| std::fs::File::open(path).map(std::io::BufReader::new);
    let of_gif = image::codecs::gif::GifDecoder::new(read(&gif)?)?.into_frames().collect_frames()?;
    let of_png = image::codecs::png::PngDecoder::new(read(&apng)?)?.apng()?.into_frames().collect_frames()?;
    for frames in [&of_gif, &of_png] {
        assert_eq!(frames.len(), 5, "frames 0, 5, 10, 15 and 20");
        let millis: Vec<u32> = frames.iter().map(|frame| frame.delay().numer_denom_ms()).map(|(n, d)| n / d).collect();
        assert!(millis[..4].iter().all(|millis| (190..=210).contains(millis)), "{millis:?}");
        assert!(frames[0].buffer() != frames[4].buffer());
    }
    let video = client(&["render", &take, "--mp4", &mp4, "--size", "64x64", "--every", "5"])?;
    if Command::new("ffmpeg").arg("-version").output().is_ok() {
        check(&video)?;
        let bytes = std::fs::read(&mp4)?;
        assert!(bytes.len() > 500 && &bytes[4..8] == b"ftyp");
    } else {
        assert!(!video.status.success() && stderr(&video).contains("not installed"), "{}", stderr(&video));
    }
    Ok(())
}

fn views_show_different_things() -> Result<(), Failed> {
    let out = folder("views");
    let feed = feed(&out, None);
    let mut seen = Vec::new();
    for view in ["beauty", "normals", "influence:stretch"] {
        let of_view = out.join(view.replace(':', "_"));
        check(&render(&feed, &of_view, &["--every", "1000", "--view", view])?)?;
        seen.push(std::fs::read(of_view.join("00000.png"))?);
    }
    assert!(seen[0] != seen[1] && seen[1] != seen[2] && seen[0] != seen[2]);
    Ok(())
}

fn two_processes_draw_the_same_bytes() -> Result<(), Failed> {
    let out = folder("same");
    let feed = feed(&out, None);
    for run in ["a", "b"] {
        check(&render(&feed, &out.join(run), &["--every", "20"])?)?;
    }
    assert_eq!(pictures(&out.join("a"))?, ["00000.png", "00020.png"]);
    for name in pictures(&out.join("a"))? {
        let (a, b) = (std::fs::read(out.join("a").join(&name))?, std::fs::read(out.join("b").join(&name))?);
        assert!(a == b, "{name} differs between two runs");
    }
    Ok(())
}

/// The built-in session, whose neutral is searched for.
fn landmarks() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl")
}

fn a_neutral_is_kept_and_used_again() -> Result<(), Failed> {
    let out = folder("neutral");
    let path = |name: &str| out.join(name).display().to_string();
    check(&render(&landmarks(), &out.join("a"), &["--every", "1000", "--save-calibration", &path("a.json")])?)?;
    // One frame comes to no neutral: the one given is in use, to the last bit.
    let again = ["--limit", "1", "--calibration", &path("a.json"), "--save-calibration", &path("b.json")];
    check(&render(&landmarks(), &out.join("b"), &again)?)?;
    assert!(std::fs::read(path("a.json"))? == std::fs::read(path("b.json"))?, "a neutral survives the file");
    let (a, b) = (std::fs::read(out.join("a/00000.png"))?, std::fs::read(out.join("b/00000.png"))?);
    assert!(a != b, "with the neutral known the first face is not taken for one");
    let output = render(&landmarks(), &out.join("c"), &["--limit", "1", "--save-calibration", &path("c.json")])?;
    let said = stderr(&output);
    assert!(output.status.code() == Some(1) && said.contains("demo.ibug68.jsonl came to no neutral face"), "{said}");
    Ok(())
}

fn what_is_no_neutral_for_the_feed_is_refused() -> Result<(), Failed> {
    let out = folder("no_neutral");
    let neutral = |num_points: usize| {
        let points = vec!["[0,0,0]"; num_points].join(",");
        format!(
            r#"{{"t":1,"num_frames":9,"speed":0,"requested":false,"points":[{points}],"head_rotation":[0,0,0,1],"head_position":[0,0,1],"weights":null}}"#
        )
    };
    for (name, text, parts) in [
        ("none.json", None, ["none.json", "o such file"]),
        ("text.json", Some("neutral".to_owned()), ["text.json holds no neutral face", "line 1"]),
        ("other.json", Some(r#"{"t":1}"#.to_owned()), ["other.json holds no neutral face", "missing field `num_frames`"]),
        ("few.json", Some(neutral(67)), ["few.json is of another feed", "has 67 points, expected 68"]),
        ("flat.json", Some(neutral(68)), ["flat.json is of another feed", "do not span a face"]),
    ] {
        let path = out.join(name);
        if let Some(text) = text {
            std::fs::write(&path, text)?;
        }
        let output = render(&landmarks(), &out.join("pictures"), &["--calibration", &path.display().to_string()])?;
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert_eq!(said.trim_end().lines().count(), 1, "{said}");
        assert!(parts.iter().all(|part| said.contains(part)), "{said:?} lacks one of {parts:?}");
    }
    assert!(!out.join("pictures").exists(), "nothing is left behind");
    Ok(())
}

fn bad_line_ends_it_and_is_named() -> Result<(), Failed> {
    let out = folder("bad");
    // No number, and no JSON.
    for bad in [r#"{"type":"frame","t":0.12,"weights":{"browInnerUp":"much"}}"#, r#"{"type":"frame","t":0.12,"weights":"#] {
        let feed = feed(&out, Some((5, bad)));
        let output = render(&feed, &out.join("pictures"), &["--every", "1000"])?;
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.starts_with("error: ") && said.contains("feed.jsonl") && said.contains("line 5"), "{said}");
        assert_eq!(said.trim_end().lines().count(), 1, "{said}");
    }
    Ok(())
}

fn still_draws_the_pose_it_is_asked_for() -> Result<(), Failed> {
    let out = folder("still");
    let draw = |name: &str, args: &[&str]| -> Result<Vec<u8>, Failed> {
        let path = out.join(name).display().to_string();
        check(&client(&[&["still", "--size", "64x64", "--out", &path], args].concat())?)?;
        Ok(std::fs::read(path)?)
    };
    let rest = draw("rest.png", &[])?;
    let stretch = draw("stretch.png", &["--pose", "stretch"])?;
    assert!(rest != stretch);
    assert!(rest == draw("none.png", &["--pose", "stretch", "--amount", "0"])?, "nothing of a pose is the face at rest");
    Ok(())
}

fn unknown_names_are_refused_with_those_there_are() -> Result<(), Failed> {
    let out = folder("unknown");
    let feed = feed(&out, None);
    let refused = |output: Output, parts: &[&str]| {
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert_eq!(said.trim_end().lines().count(), 1, "{said}");
        for part in parts {
            assert!(said.contains(part), "{said:?} lacks {part:?}");
        }
    };
    refused(render(&feed, &out.join("pictures"), &["--view", "sideways"])?, &["sideways", "beauty", "wireframe"]);
    refused(render(&feed, &out.join("pictures"), &["--view", "influence:frown"])?, &["frown", "stretch"]);
    let picture = out.join("still.png").display().to_string();
    refused(client(&["still", "--pose", "frown", "--out", &picture])?, &["pose \"frown\"", "stretch"]);
    assert!(!out.join("pictures").exists() && !out.join("still.png").exists(), "nothing is left behind");
    Ok(())
}

fn numbers_out_of_range_are_refused() -> Result<(), Failed> {
    for (args, expected) in [
        (["--zoom", "nan"], "\"nan\" is no distance, expected 0.05 to 20"),
        (["--zoom", "0"], "expected 0.05 to 20"),
        (["--orbit", "nan,0"], "expected YAW,PITCH"),
        (["--size", "0x64"], "expected WIDTHxHEIGHT"),
        (["--every", "0"], "0 is not in 1.."),
    ] {
        let output = client(&[&["render", "feed.jsonl", "--out", "nowhere"], &args[..]].concat())?;
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.lines().next().is_some_and(|line| line.contains(expected)), "{said}");
    }
    Ok(())
}
