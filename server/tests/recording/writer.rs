//! Recordings survive what ends them: a request, a kill, a full disk.

use crate::fixture::noise;
use crate::http::ask;
use crate::process::{Process, program};
use crate::server::{Folder, Recorder, run, says, wait_until};
use rhytid_server::recording::{Faces, Recording, recover};
use std::fs::OpenOptions;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

#[test]
fn a_recording_may_begin_and_end_in_the_middle_of_a_session() {
    let folder = Folder::new();
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--record-rooms", "none"]);
    assert_eq!(served.request("POST", "/api/rooms/demo/record/stop", "").0, 409);
    let sending = served.keep_sending("1.0");
    wait_until("frames", || served.metric("rhytid_frames_in_total") > 10.0);
    let begun = served.json("POST", "/api/rooms/demo/record/start", "");
    assert!(begun["recording"]["file"].as_str().unwrap().starts_with("demo-"), "{begun}");
    assert_eq!(served.request("POST", "/api/rooms/demo/record/start", "").0, 409, "once");
    std::thread::sleep(Duration::from_millis(1500));
    assert!(served.json("GET", "/api/rooms", "")["rooms"][0]["recording"]["bytes"].as_u64().unwrap() > 1000);
    served.json("POST", "/api/rooms/demo/record/stop", "");
    wait_until("its end", || served.metric("rhytid_recordings") == 0.0);
    let listed = served.json("GET", "/api/recordings", "");
    assert_eq!(listed["recordings"].as_array().unwrap().len(), 1);
    drop(sending);
    let recording = Recording::open(&folder.recording()).unwrap();
    assert_eq!(recording.cut_off(), None, "it is finished");
    let mut faces = Faces::new(recording);
    let mut num = 0;
    while faces.advance().unwrap().is_some() {
        num += 1;
    }
    assert!(num > 20 && faces.num_unreadable() == 0, "{num} faces, {} unreadable", faces.num_unreadable());
    let verified = run(&["verify", folder.recording().to_str().unwrap()]);
    assert!(!verified.status.success() && says(&verified).contains("nothing in it can be solved again"), "{}", says(&verified));
    // Another site's page may not.
    let origin = ["Origin: http://evil.example"];
    let (status, answer) = ask(&served.address, "POST", "/api/rooms/demo/record/start", &origin, "").unwrap();
    assert_eq!(status, 403, "{answer}");
}

#[test]
fn a_hundred_kills_lose_the_last_second_at_most() {
    let folder = Folder::new();
    let served = Recorder::start(&["serve"]);
    let _sending = served.keep_sending("1.0");
    wait_until("frames", || served.metric("rhytid_frames_in_total") > 2.0);
    let now = || SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    let (mut worst, mut num_cut, mut num_faces) = (0.0f64, 0, 0);
    for round in 0..5 {
        let mut children: Vec<(f64, PathBuf, Process)> = (0..20)
            .map(|i| {
                let path = folder.path(&format!("{round}-{i}.mcap"));
                let mut command = program(&["record", path.to_str().unwrap(), "--server", &served.url()]);
                let child = Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
                (now() + 0.02 + 2.5 * noise(round * 20 + i), path, child)
            })
            .collect();
        children.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (at, path, mut child) in children {
            std::thread::sleep(Duration::from_secs_f64((at - now()).max(0.0)));
            let killed = now();
            child.kill().unwrap();
            child.wait().unwrap();
            if !path.exists() || std::fs::metadata(&path).unwrap().len() < 200 {
                // Process before its first chunk: younger than a second.
                continue;
            }
            let report = recover(&path, None).unwrap();
            assert!(!report.was_whole);
            num_cut += usize::from(report.cut_off > 0);
            let recording = Recording::open(&path).unwrap();
            assert_eq!(recording.cut_off(), None, "it is mended");
            let start = recording.start() as f64 / 1e9;
            let mut faces = Faces::new(recording);
            let mut last = None;
            while let Some(moment) = faces.advance().unwrap() {
                last = Some(moment.at);
                num_faces += 1;
            }
            assert_eq!(faces.num_unreadable(), 0);
            worst = worst.max(killed - (start + last.unwrap_or(0.0)));
            assert!(recover(&path, None).unwrap().was_whole, "mended once is mended");
        }
    }
    println!("worst loss {worst:.2} s; {num_cut} files were cut inside a chunk; {num_faces} faces in all");
    assert!(num_faces > 500);
    // Half a second more for a machine that has better things to do.
    assert!(worst < 1.5, "{worst} s");
}

#[test]
fn a_killed_server_leaves_recordings_that_verify() {
    let folder = Folder::new();
    let served = Recorder::into(&folder);
    let sending = served.keep_sending("1.0");
    wait_until("frames", || served.metric("rhytid_frames_in_total") > 60.0);
    drop(served);
    drop(sending);
    let path = folder.recording();
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(verified.status.success(), "before it is mended: {}", says(&verified));
    let mended = run(&["recover", path.to_str().unwrap()]);
    assert!(mended.status.success() && says(&mended).contains("kept "), "{}", says(&mended));
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(verified.status.success(), "{}", says(&verified));
}

#[test]
fn a_recording_that_cannot_be_made_says_why_and_not_where() {
    let folder = Folder::new();
    let takes = folder.path("takes");
    std::fs::create_dir(&takes).unwrap();
    let served = Recorder::start(&["serve", "--record", takes.to_str().unwrap(), "--record-rooms", "none"]);
    std::fs::remove_dir(&takes).unwrap();
    let (status, answer) = served.request("POST", "/api/rooms/demo/record/start", "");
    assert_eq!(status, 500, "{answer}");
    let told = served.request("GET", "/api/rooms", "").1;
    for text in [answer, told] {
        assert!(text.contains("cannot make demo-") && text.contains("No such file") && !text.contains(folder.shown()), "{text}");
    }
    wait_until("the folder in the log", || served.log().contains(folder.shown()));
}

#[test]
fn of_two_who_begin_a_recording_at_once_one_leaves_a_file() {
    let folder = Folder::new();
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--record-rooms", "none"]);
    for room in 0..10 {
        let path = format!("/api/rooms/room{room}/record/start");
        let answers = std::thread::scope(|scope| {
            let asking: Vec<_> = (0..8).map(|_| scope.spawn(|| served.request("POST", &path, "").0)).collect();
            asking.into_iter().map(|asking| asking.join().unwrap()).collect::<Vec<_>>()
        });
        assert_eq!(answers.iter().filter(|status| **status == 200).count(), 1, "{answers:?}");
    }
    assert_eq!((folder.files().len(), served.metric("rhytid_recordings")), (10, 10.0));
}

#[test]
fn a_full_disk_ends_the_recording_and_not_the_stream() {
    let folder = Folder::new();
    // 64 blocks of 512 or 1,024 bytes.
    let limited = ["sh", "-c", r#"ulimit -f 64; exec "$0" "$@""#];
    let served = Recorder::try_start(&limited, &["serve", "--record", folder.shown()]).unwrap();
    let sending = served.keep_sending("4.0");
    wait_until("the failure", || served.metric("rhytid_recording_failures_total") >= 1.0);
    let before = served.metric("rhytid_frames_in_total");
    wait_until("more frames", || served.metric("rhytid_frames_in_total") > before + 50.0);
    let recording = &served.json("GET", "/api/rooms", "")["rooms"][0]["recording"];
    assert!(recording["error"].as_str().unwrap().contains("File too large"), "{recording}");
    drop(sending);
    drop(served);
    let files = folder.files();
    assert!(files.iter().all(|file| std::fs::metadata(file).unwrap().len() > 0), "{files:?}");
    let report = recover(&files[0], None).unwrap();
    assert!(report.packets > 20, "{report:?}");
}

/// What stands in a file is no reason to remove it, and is not looked at: reading it could take minutes.
#[test]
fn a_failed_recording_is_kept_whatever_stands_in_it_unless_nothing_does() {
    let folder = Folder::new();
    let limited = ["sh", "-c", r#"ulimit -f 64; exec "$0" "$@""#];
    let served = Recorder::try_start(&limited, &["serve", "--record", folder.shown()]).unwrap();
    let sending = served.keep_sending("4.0");
    let length = |path: &PathBuf| std::fs::metadata(path).map_or(0, |about| about.len());
    wait_until("chunks", || folder.files().iter().any(|file| length(file) > 4000));
    let file = folder.files().remove(0);
    // As if the disk had lost a byte.
    std::os::unix::fs::FileExt::write_at(&OpenOptions::new().write(true).open(&file).unwrap(), b"?", 0).unwrap();
    wait_until("the failure", || served.metric("rhytid_recording_failures_total") >= 1.0);
    drop(sending);
    drop(served);
    assert!(length(&file) > 4000, "it is still there");
    // Nothing at all fits.
    let folder = Folder::new();
    let limited = ["sh", "-c", r#"ulimit -f 0; exec "$0" "$@""#];
    let served = Recorder::try_start(&limited, &["serve", "--record", folder.shown()]).unwrap();
    let _sending = served.keep_sending("1.0");
    wait_until("the failure", || served.metric("rhytid_recording_failures_total") >= 1.0);
    wait_until("an empty folder", || folder.files().is_empty());
}

#[test]
fn a_recording_is_not_mended_while_it_is_written_and_a_killed_mending_may_be_done_again() {
    let folder = Folder::new();
    let served = Recorder::into(&folder);
    let sending = served.keep_sending("1.0");
    wait_until("frames", || served.metric("rhytid_frames_in_total") > 40.0);
    let path = folder.recording();
    let shown = path.to_str().unwrap();
    let refused = run(&["recover", shown]);
    assert!(!refused.status.success() && says(&refused).contains("is still being written"), "{}", says(&refused));
    let copy = folder.path("copy");
    let copied = run(&["recover", shown, "--out", copy.to_str().unwrap()]);
    assert!(copied.status.success(), "what stands in it so far may be had: {}", says(&copied));
    let before = served.metric("rhytid_recorded_bytes_total");
    wait_until("more of it", || served.metric("rhytid_recorded_bytes_total") > before + 1000.0);
    assert!(std::fs::metadata(&path).unwrap().len() as f64 > before, "it is the file that is written");
    drop(served);
    drop(sending);
    let name = path.file_name().unwrap().to_str().unwrap();
    // Somebody's own, and where a mending makes its file a link to it.
    let own = folder.path(&format!("{name}.mended"));
    std::fs::write(&own, "mine").unwrap();
    let left = folder.path(&format!(".{name}.rhytid-mending"));
    std::os::unix::fs::symlink(&own, &left).unwrap();
    let refused = run(&["recover", shown]);
    assert!(!refused.status.success() && says(&refused).contains("cannot write"), "{}", says(&refused));
    assert!(left.is_symlink());
    std::fs::remove_file(&left).unwrap();
    // A mending that was killed has left this.
    std::fs::write(&left, vec![7; 100_000]).unwrap();
    let mended = run(&["recover", shown]);
    assert_eq!(std::fs::read_to_string(&own).unwrap(), "mine");
    assert!(mended.status.success() && says(&mended).contains("kept "), "{}", says(&mended));
    assert!(!left.exists());
    let verified = run(&["verify", shown]);
    assert!(verified.status.success(), "{}", says(&verified));
}
