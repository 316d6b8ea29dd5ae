//! Playout over a simulated link: a sender with its own clock, a network that delays, stalls, reorders and repeats.

use super::*;
use glam::{Quat, Vec3};
use proptest::prelude::*;
use rhytid_shared::HeadPose;

const MS: i64 = 1000;

fn ms(millis: i64) -> Duration {
    Duration::from_micros((millis * MS).unsigned_abs())
}

/// A face of two bones and one pose whose every value is a function of `x`.
fn face(session: u32, seq: u32, captured_at: i64, x: f32) -> FaceFrame {
    FaceFrame {
        session,
        seq,
        captured_at_micros: captured_at.unsigned_abs(),
        face: true,
        points: vec![Vec3::new(0.03, 0.05 + 0.01 * x, 0.09), Vec3::new(0.0, -0.08, 0.1)],
        rotations: vec![Quat::IDENTITY, Quat::from_rotation_x(0.4 * x)],
        influences: vec![x, 0.5 * x],
        zones: Vec::new(),
        stretched: Vec::new(),
        shapes: None,
        head: HeadPose { rotation: Quat::from_rotation_y(0.3 * x), position: Vec3::new(0.0, 0.02 * x, 0.0) },
    }
}

fn playout() -> Playout {
    Playout::with_rest(at_rest())
}

fn at_rest() -> RenderFrame {
    RenderFrame::from(&face(0, 0, 0, 0.0))
}

/// The first influence: what the tests follow.
fn x(frame: &RenderFrame) -> f32 {
    frame.influences[0]
}

/// Sends `count` frames of `value` at 25 Hz from `start` (viewer's clock, ms) and samples at 50 Hz; returns the time after.
fn play(playout: &mut Playout, session: u32, start: i64, count: u32, value: impl Fn(i64) -> f32) -> i64 {
    for k in 0..i64::from(count) {
        let now = start + 40 * k;
        playout.push(&face(session, k as u32, 40 * MS * k, value(40 * k)), ms(now));
        playout.sample(ms(now));
        playout.sample(ms(now + 20));
    }
    start + 40 * i64::from(count)
}

#[test]
fn a_moment_between_two_frames_is_interpolated() {
    // Shown at 1012 ms of the sender's clock, between 1000 and 1033: u = 0.3636363636, 0.2 -> 0.8 gives 0.4181818182.
    let mut session = Session {
        id: 1,
        clock: PlayoutClock::starting(1000 * MS, 0),
        frames: [(1000, 0.2), (1033, 0.8)]
            .map(|(at, value)| Snapshot { captured_at: at * MS, face: true, frame: RenderFrame::from(&face(1, 0, 0, value)) })
            .into(),
        received: SequenceWindow::starting(0),
        newest_came_at: 33 * MS,
        underrun: 0,
    };
    let rest = at_rest();
    let mut out = rest.clone();
    assert_eq!(session.sample(1012 * MS, 45 * MS, &rest, &mut out), PlayoutState::Live);
    assert!((x(&out) - 0.418_181_8).abs() < 1e-6, "{}", x(&out));
    assert!((out.influences[1] - 0.209_090_9).abs() < 1e-6);
    assert!((out.points[0].y - (0.05 + 0.004_181_818)).abs() < 1e-6, "bones move with the same u");
}

#[test]
fn rotations_take_the_shorter_way() {
    let a = RenderFrame::from(&face(1, 0, 0, 0.0));
    let mut b = a.clone();
    b.rotations[0] = -Quat::from_rotation_z(0.4);
    b.head.rotation = -Quat::from_rotation_z(0.4);
    let mut out = a.clone();
    mix::mix(&a, &b, 0.5, &mut out);
    for rotation in [out.rotations[0], out.head.rotation] {
        assert!((rotation.to_axis_angle().1.to_degrees() - 11.459_156).abs() < 1e-3, "{rotation}");
    }
}

#[test]
fn first_face_is_shown_at_once() {
    let mut playout = playout();
    assert_eq!(*playout.sample(ms(0)), at_rest());
    assert_eq!(playout.state(), PlayoutState::Waiting);
    assert_eq!(playout.push(&face(1, 700, 5_000_000, 0.6), ms(10)), Pushed::NewSession);
    assert_eq!(x(playout.sample(ms(10))), 0.6);
    assert_eq!(playout.state(), PlayoutState::Live);
}

#[test]
fn late_and_duplicate_frames_are_ignored_and_counted() {
    let mut playout = playout();
    for seq in [0, 1, 3] {
        playout.push(&face(1, seq, 40 * MS * i64::from(seq), 0.1), ms(40 * i64::from(seq)));
    }
    assert_eq!(playout.push(&face(1, 2, 80 * MS, 0.9), ms(121)), Pushed::Late);
    assert_eq!(playout.push(&face(1, 3, 120 * MS, 0.9), ms(122)), Pushed::Duplicate);
    assert_eq!(playout.push(&face(1, 0, 0, 0.9), ms(123)), Pushed::Duplicate);
    assert_eq!(playout.push(&face(1, 4, 120 * MS, 0.9), ms(124)), Pushed::Late, "time stands still");
    let stats = playout.stats();
    assert_eq!((stats.accepted, stats.late, stats.duplicates, stats.sessions), (3, 2, 2, 1));
    for now in 0..40 {
        assert!(x(playout.sample(ms(124 + 5 * now))) <= 0.1 + 1e-6);
    }
}

#[test]
fn frame_of_another_character_is_ignored() {
    let mut playout = playout();
    let mut frame = face(1, 0, 0, 0.5);
    frame.influences.push(0.5);
    assert_eq!(playout.push(&frame, ms(0)), Pushed::Misfit);
    assert_eq!(playout.stats().misfits, 1);
    assert_eq!(*playout.sample(ms(1)), at_rest());
}

#[test]
fn new_session_forgets_the_old_and_old_sessions_stay_forgotten() {
    let mut playout = playout();
    let end = play(&mut playout, 1, 0, 50, |_| 0.8);
    // Its sender's clock starts anew, far below the old one.
    assert_eq!(playout.push(&face(2, 0, 0, 0.2), ms(end)), Pushed::NewSession);
    assert_eq!(playout.push(&face(1, 50, 2000 * MS, 0.8), ms(end + 1)), Pushed::Late);
    let at_the_change = x(playout.sample(ms(end)));
    assert!((at_the_change - 0.8).abs() < 0.02, "no jump at the change: {at_the_change}");
    assert!((x(playout.sample(ms(end + 250))) - 0.2).abs() < 1e-3);
}

#[test]
fn new_connection_may_count_sessions_anew() {
    let mut playout = playout();
    let end = play(&mut playout, 9, 0, 50, |_| 0.8);
    playout.reconnected(ms(end));
    assert!((x(playout.sample(ms(end))) - 0.8).abs() < 1e-3);
    assert_eq!(playout.state(), PlayoutState::Waiting);
    assert!(x(playout.sample(ms(end + 500))) < 1e-3, "nobody publishes: at rest");
    assert_eq!(playout.push(&face(1, 0, 0, 0.4), ms(end + 600)), Pushed::NewSession);
}

#[test]
fn silence_is_held_then_eased_to_neutral_and_left_without_a_jump() {
    let mut playout = playout();
    let end = play(&mut playout, 1, 0, 50, |_| 0.8);
    // The newest frame is shown when its moment comes: the delay after it was received.
    let reached = end - 40 + playout.stats().delay.as_millis() as i64;
    assert_eq!(x(playout.sample(ms(reached + 245))), 0.8);
    assert_eq!(playout.state(), PlayoutState::Live);
    let mut before = 0.8;
    for now in (reached + 250..reached + 750).step_by(10) {
        let frame = playout.sample(ms(now)).clone();
        assert!(x(&frame) <= before && x(&frame) > before - 0.03, "eases evenly: {before} -> {}", x(&frame));
        before = x(&frame);
        // Bones and coefficients are eased by the same amount.
        assert!((frame.points[0].y - (0.05 + 0.01 * before)).abs() < 1e-6);
    }
    assert_eq!(playout.state(), PlayoutState::Silent);
    assert_eq!(*playout.sample(ms(reached + 760)), at_rest());
    assert_eq!(playout.state(), PlayoutState::Idle);

    // Two seconds later the sender is back, its clock having run on.
    let mut before = 0.0;
    for k in 0..40 {
        let now = end + 2000 + 40 * k;
        playout.push(&face(1, 50 + k as u32, (2000 + 2000 + 40 * k) * MS, 0.8), ms(now));
        for part in 0..8 {
            let value = x(playout.sample(ms(now + 5 * part)));
            assert!(value - before < 0.05 && value >= before - 1e-5, "{before} -> {value}");
            before = value;
        }
    }
    assert!((before - 0.8).abs() < 1e-4);
    assert_eq!(playout.state(), PlayoutState::Live);
}

#[test]
fn frame_that_ends_a_silence_without_catching_up_makes_no_jump() {
    let mut playout = playout();
    let end = play(&mut playout, 1, 0, 50, |_| 0.8);
    let mut before = 0.8;
    for now in (end..end + 700).step_by(16) {
        before = x(playout.sample(ms(now)));
    }
    assert!(playout.state() == PlayoutState::Silent && before < 0.3, "{:?} {before}", playout.state());
    // Older by more than the time since the last picture: the moment shown is now even further past the newest frame.
    assert_eq!(playout.push(&face(1, 50, 49 * 40 * MS + 10 * MS, 0.8), ms(end + 705)), Pushed::Accepted);
    let value = x(playout.sample(ms(end + 720)));
    assert!((value - before).abs() < 0.02, "{before} -> {value}");
    assert_eq!(playout.state(), PlayoutState::Live);
}

#[test]
fn face_follows_frames_that_come_evenly_but_late() {
    let mut playout = playout();
    let interval = 1_000_000 / 60;
    for k in 0..180_u32 {
        // After a second the way takes 60 ms longer, which is more than the delay covers until it has grown.
        let captured_at = interval * i64::from(k);
        let now = Duration::from_micros((captured_at + if k < 60 { 0 } else { 60 * MS }).unsigned_abs());
        let value = k as f32 / 180.0;
        playout.push(&face(1, k, captured_at, value), now);
        let shown = x(playout.sample(now));
        if (72..85).contains(&k) {
            assert!(playout.session.as_ref().is_some_and(|session| session.underrun > 0), "the test must run dry: frame {k}");
            assert!(value - shown < 1.0 / 180.0, "frame {k}: {value} has come, {shown} is shown");
        }
    }
}

#[test]
fn lost_face_is_said_at_its_own_moment() {
    let mut playout = playout();
    for k in 0..100 {
        let mut frame = face(1, k, 40 * MS * i64::from(k), 0.5);
        frame.face = k < 50;
        playout.push(&frame, ms(40 * i64::from(k)));
        playout.sample(ms(40 * i64::from(k)));
        if k == 50 {
            assert_eq!(playout.state(), PlayoutState::Live, "the frame without a face has come, but its moment has not");
        }
    }
    assert_eq!(playout.state(), PlayoutState::FaceLost);
}

#[test]
fn after_a_burst_only_what_is_needed_is_kept() {
    let mut playout = playout();
    let end = play(&mut playout, 1, 0, 50, |_| 0.5);
    // 400 ms of silence, then everything at once.
    let now = end + 400;
    playout.sample(ms(now - 10));
    for k in 50..60 {
        playout.push(&face(1, k, 40 * MS * i64::from(k), 0.5), ms(now));
    }
    playout.sample(ms(now));
    let held = playout.stats().buffered;
    assert!(held <= 2 + 250 / 40, "{held} frames held");
    assert_eq!(playout.stats().underruns, 1);
}

#[test]
fn buffer_is_bounded_whatever_the_sender_does() {
    let mut playout = playout();
    for k in 0..5000 {
        playout.push(&face(1, k, i64::from(k) * 10, 0.5), ms(0));
    }
    assert!(playout.stats().buffered <= MAX_BUFFERED);
    // And the largest clock there is does no harm.
    let mut frame = face(1, 5000, 0, 0.5);
    frame.captured_at_micros = u64::MAX;
    playout.push(&frame, ms(1));
    assert!(playout.sample(ms(2)).points[0].is_finite());
}

/// How the simulated link misbehaves. Times in milliseconds.
#[derive(Debug, Clone, Copy)]
struct Weather {
    fps: f64,
    /// Sender's clock against the viewer's: how much faster it runs, and where it stood.
    drift: f64,
    skew: i64,
    jitter: i64,
    /// Every packet sent within the last `stall` of each `stall_every` arrives at its end (TCP).
    stall_every: i64,
    stall: i64,
    /// One in this many is sent twice; one in this many overtakes its neighbour. 0 for never.
    repeat_one_in: u64,
    reorder_one_in: u64,
}

const FAIR: Weather = Weather { fps: 25.0, drift: 0.0, skew: 0, jitter: 0, stall_every: 0, stall: 0, repeat_one_in: 0, reorder_one_in: 0 };

/// What a simulated viewer saw.
#[derive(Debug)]
struct Seen {
    /// Largest difference to the true face at the moment shown, after the first second, where frames had not run out.
    worst_error: f32,
    /// Largest change from one picture (60 Hz) to the next, after the first.
    worst_step: f32,
    /// Smallest and largest pace of the moment shown against the viewer's clock, jumps apart.
    pace: [f64; 2],
    stats: PlayoutStats,
}

/// The true face: 1.3 Hz, about the speed of a fast brow.
fn truth(captured_at: i64) -> f32 {
    let phase = captured_at as f64 * 1e-6 * 1.3 * std::f64::consts::TAU;
    (0.5 - 0.5 * phase.cos()) as f32
}

/// When which frames arrive, in order of arrival; `value` is the face by the time of its capture.
fn arrivals(weather: Weather, seconds: i64, seed: u64, value: impl Fn(i64) -> f32) -> Vec<(i64, FaceFrame)> {
    let mut state = seed;
    let mut random = move || {
        // splitmix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    let mut arrivals: Vec<(i64, FaceFrame)> = Vec::new();
    let mut last = 0;
    for k in 0..(seconds as f64 * weather.fps) as i64 {
        let sent = (k as f64 * 1e6 / weather.fps) as i64;
        let captured_at = weather.skew * MS + (sent as f64 * (1.0 + weather.drift)) as i64;
        let mut arrives = sent + 20 * MS + (random() % (weather.jitter * MS + 1).unsigned_abs()) as i64;
        if weather.stall_every > 0 {
            let into = sent % (weather.stall_every * MS);
            if into >= (weather.stall_every - weather.stall) * MS {
                arrives = arrives.max(sent - into + weather.stall_every * MS);
            }
        }
        // A stream keeps its order unless the weather says otherwise.
        if weather.reorder_one_in == 0 || !random().is_multiple_of(weather.reorder_one_in) {
            arrives = arrives.max(last);
        }
        last = last.max(arrives);
        let frame = face(1, k as u32, captured_at, value(captured_at));
        if weather.repeat_one_in > 0 && random().is_multiple_of(weather.repeat_one_in) {
            arrivals.push((arrives + 1, frame.clone()));
        }
        arrivals.push((arrives, frame));
    }
    arrivals.sort_by_key(|(at, _)| *at);
    arrivals
}

fn simulate(weather: Weather, seconds: i64, seed: u64) -> Seen {
    let arrivals = arrivals(weather, seconds, seed, truth);
    let mut playout = playout();
    let mut arrivals = arrivals.into_iter().peekable();
    let mut seen = Seen { worst_error: 0.0, worst_step: 0.0, pace: [f64::MAX, f64::MIN], stats: PlayoutStats::default() };
    let mut before: Option<(f32, i64)> = None;
    let picture = 1_000_000 / 60;
    let mut now = 0;
    while now < (seconds - 1) * 1000 * MS {
        while let Some((at, frame)) = arrivals.next_if(|(at, _)| *at <= now) {
            playout.push(&frame, Duration::from_micros(at.unsigned_abs()));
        }
        let value = x(playout.sample(Duration::from_micros(now.unsigned_abs())));
        if let Some(session) = &playout.session {
            let play_time = session.clock.play_time(now);
            if let Some((value_before, play_time_before)) = before {
                seen.worst_step = seen.worst_step.max((value - value_before).abs());
                let pace = (play_time - play_time_before) as f64 / picture as f64;
                seen.pace = [seen.pace[0].min(pace), seen.pace[1].max(pace)];
            }
            if now > 1000 * MS && session.underrun == 0 && playout.blend.is_none() {
                seen.worst_error = seen.worst_error.max((value - truth(play_time)).abs());
            }
            before = Some((value, play_time));
        }
        now += picture;
    }
    seen.stats = playout.stats();
    seen
}

/// The fastest the true face moves between two pictures at 60 Hz.
const TRUE_STEP: f32 = 1.3 * std::f32::consts::PI / 60.0;
/// What straight lines between samples at 25 Hz leave of it.
const CHORD_ERROR: f32 = 0.015;

#[test]
fn fair_weather_shows_the_true_face_80_ms_late() {
    let seen = simulate(FAIR, 12, 1);
    assert!(seen.worst_error < CHORD_ERROR, "{seen:?}");
    assert!(seen.worst_step < TRUE_STEP * 1.1, "{seen:?}");
    assert_eq!(seen.stats.underruns, 0);
    assert!((79..=81).contains(&seen.stats.delay.as_millis()), "{seen:?}");
}

#[test]
fn jitter_is_covered_by_the_delay() {
    let seen = simulate(Weather { jitter: 60, ..FAIR }, 30, 2);
    assert!(seen.worst_error < CHORD_ERROR && seen.worst_step < TRUE_STEP * 1.15, "{seen:?}");
    assert!((100..=145).contains(&seen.stats.delay.as_millis()), "{seen:?}");
    assert!(seen.stats.underruns <= 2, "{seen:?}");
}

#[test]
fn stalls_and_bursts_never_make_the_face_jump() {
    let seen = simulate(Weather { stall_every: 3000, stall: 320, ..FAIR }, 30, 3);
    assert!(seen.stats.underruns >= 3, "the test must run dry: {seen:?}");
    assert!(seen.worst_step < TRUE_STEP * 3.0, "{seen:?}");
    assert!(seen.worst_error < CHORD_ERROR, "{seen:?}");
}

#[test]
fn short_gap_after_a_long_one_does_not_hurry_the_face() {
    // At 2.58 s a gap of 25 us cuts short the blend that makes up for one of 140 ms. Found by the property below.
    let weather = Weather {
        fps: 104.666_998_267_195_75,
        drift: -0.003_158_316_547_460_624,
        skew: 10_173_533,
        jitter: 102,
        stall_every: 2500,
        stall: 255,
        repeat_one_in: 1,
        reorder_one_in: 3,
    };
    let seen = simulate(weather, 12, 9_941_353_126_481_814_668);
    assert!(seen.stats.underruns >= 3, "the test must run dry: {seen:?}");
    assert!(seen.worst_step < TRUE_STEP * 3.0, "{seen:?}");
}

#[test]
fn clocks_that_differ_and_drift_are_followed() {
    for drift in [0.005, -0.005] {
        let seen = simulate(Weather { drift, skew: 86_400_000, jitter: 10, ..FAIR }, 60, 4);
        assert!(seen.worst_error < CHORD_ERROR && seen.worst_step < TRUE_STEP * 1.15, "{seen:?}");
        assert!(seen.stats.delay.as_millis() <= 150, "{seen:?}");
    }
}

#[test]
fn reordered_and_repeated_packets_are_left_out() {
    let seen = simulate(Weather { jitter: 90, reorder_one_in: 3, repeat_one_in: 5, ..FAIR }, 30, 5);
    assert!(seen.stats.late > 10 && seen.stats.duplicates > 10, "{seen:?}");
    // Between the neighbours of a frame left out the line is longer.
    assert!(seen.worst_error < 4.0 * CHORD_ERROR && seen.worst_step < TRUE_STEP * 1.5, "{seen:?}");
}

#[test]
fn feed_played_at_half_speed_never_looks_like_silence() {
    let mut playout = playout();
    for k in 0..500 {
        // 25 frames a second that are 20 ms apart on the sender's clock.
        playout.push(&face(1, k, 20 * MS * i64::from(k), 0.5), ms(40 * i64::from(k)));
        playout.sample(ms(40 * i64::from(k)));
        assert_eq!(playout.state(), PlayoutState::Live, "after {k} frames");
        assert!(x(playout.sample(ms(40 * i64::from(k) + 20))) > 0.49, "the newest frame is held");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn whatever_the_weather_the_face_stays_in_range_and_at_life_s_pace(
        fps in 10.0..120.0_f64, drift in -0.01..0.01_f64, skew in 0..100_000_000_i64, jitter in 0..150_i64,
        stall in 0..600_i64, repeat_one_in in 0..6_u64, reorder_one_in in 0..6_u64, seed: u64,
    ) {
        let seen = simulate(Weather { fps, drift, skew, jitter, stall_every: 2500, stall, repeat_one_in, reorder_one_in }, 12, seed);
        prop_assert!((0.949..=1.051).contains(&seen.pace[0]) && seen.pace[1] <= 1.051, "{seen:?}");
        prop_assert!((40..=500).contains(&seen.stats.delay.as_millis()), "{seen:?}");
        prop_assert!(seen.worst_step < 0.35, "{seen:?}");
    }

    #[test]
    fn face_that_only_rises_is_never_seen_to_fall_and_ends_on_its_last_frame(
        fps in 10.0..120.0_f64, jitter in 0..150_i64, stall in 0..600_i64, repeat_one_in in 0..6_u64,
        breaks_at in 2000..7000_i64, away in 0..1000_i64, seed: u64,
    ) {
        let weather = Weather { jitter, stall_every: 2500, stall, repeat_one_in, fps, ..FAIR };
        // It rises for eight seconds and then stays as it is.
        let mut arrivals = arrivals(weather, 10, seed, |captured_at| (captured_at as f32 / (8000 * MS) as f32).min(1.0)).into_iter().peekable();
        let mut playout = playout();
        // What is under way when the connection breaks is lost, and what comes before the next one stands.
        let (breaks, back) = (breaks_at * MS, (breaks_at + away) * MS);
        let (mut is_back, mut newest_lost) = (false, None);
        let (mut before, mut highest) = (0.0_f32, 0.0_f32);
        for now in (0..10_000 * MS).step_by(1_000_000 / 60) {
            while let Some((at, frame)) = arrivals.next_if(|(at, _)| *at <= now) {
                let at_viewer = Duration::from_micros(at.unsigned_abs());
                if (breaks..back).contains(&at) {
                    newest_lost = Some(frame);
                    continue;
                }
                if at >= back && !std::mem::replace(&mut is_back, true) {
                    // A new connection begins with the newest state.
                    playout.reconnected(at_viewer);
                    newest_lost.take().map(|frame| playout.push(&frame, at_viewer));
                }
                playout.push(&frame, at_viewer);
            }
            let value = x(playout.sample(Duration::from_micros(now.unsigned_abs())));
            // Easing to neutral in silence shows no frame.
            let is_eased = matches!(playout.state(), PlayoutState::Silent | PlayoutState::Idle);
            prop_assert!(is_eased || value >= before - 1e-5, "{value} after {before} at {now}: {weather:?}");
            before = value;
            highest = highest.max(value);
        }
        prop_assert!((highest - 1.0).abs() < 1e-5, "it ends on {highest}: {weather:?}");
    }

    #[test]
    fn sequence_window_knows_what_came(seqs in prop::collection::vec(0_u32..200, 1..300), start in prop::sample::select(vec![0_u32, u32::MAX - 100])) {
        let mut window = SequenceWindow::starting(start);
        let mut came = vec![0_u32];
        for seq in seqs {
            let newest = *came.iter().max().expect("it starts with one");
            let expected = if seq > newest { 0 } else if came.contains(&seq) && newest - seq < 64 { 1 } else { 2 };
            let got = match window.note(start.wrapping_add(seq)) { Arrival::Newest => 0, Arrival::Duplicate => 1, Arrival::Late => 2 };
            prop_assert_eq!(got, expected);
            came.push(seq);
        }
    }
}
