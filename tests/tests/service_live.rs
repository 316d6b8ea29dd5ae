//! The programs themselves, as users start them: `serve`, `send` and `film` together, and the README's tracker in Python.
//! What a machine lacks shows as ignored.

use anyhow::{Context, Result, ensure};
use libtest_mimic::{Arguments, Failed, Trial};
use rhytid_client::renderer::AdapterChoice;
use rhytid_client::{CharacterAsset, Headless};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use rhytid_tests::program;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

/// Longer than anything here takes, with a software adapter on a busy machine; a test that waits for it has failed.
const PATIENCE: Duration = Duration::from_secs(180);

fn main() -> ExitCode {
    let trial = |name: &str, can_run: bool, test: fn() -> Result<()>| {
        Trial::test(name, move || test().map_err(|error| Failed::from(format!("{error:#}")))).with_ignored_flag(!can_run)
    };
    let trials = vec![
        trial("a_session_that_is_served_and_sent_is_filmed", has_software_adapter(), a_session_that_is_served_and_sent_is_filmed),
        trial("the_tracker_of_the_readme_moves_a_face", has_websockets(), the_tracker_of_the_readme_moves_a_face),
    ];
    libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
}

fn has_software_adapter() -> bool {
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
    Headless::on(&asset, AdapterChoice::Software).is_ok()
}

fn has_websockets() -> bool {
    Command::new("python3")
        .args(["-c", "import websockets"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

/// The workspace's folder.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// A process that ends with the test.
struct Running(Child);

impl Running {
    /// Waits for its end, which must be a good one; gives what it said on standard error.
    fn finish(mut self, what: &str) -> Result<()> {
        let mut stderr = self.0.stderr.take().context("piped")?;
        let reader = std::thread::spawn(move || {
            let mut said = String::new();
            // Half of it is better than none.
            let _ = stderr.read_to_string(&mut said);
            said
        });
        let start = Instant::now();
        let status = loop {
            match self.0.try_wait()? {
                Some(status) => break status,
                None => ensure!(start.elapsed() < PATIENCE, "{what} does not end"),
            }
            std::thread::sleep(Duration::from_millis(50));
        };
        let said = reader.join().expect("reading does not panic");
        ensure!(status.success(), "{what} ended with {status}: {said}");
        Ok(())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts `serve` on a free port; gives its address, too.
fn serve() -> Result<(Running, String)> {
    let mut child = Command::new(program("rhytid-server")?)
        .args(["serve", "--listen", "127.0.0.1:0"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()?;
    let mut line = String::new();
    let output = child.stdout.take().context("piped")?;
    let server = Running(child);
    BufReader::new(output).read_line(&mut line)?;
    let address = line.trim().strip_prefix("listening on http://").context("its first line says where it listens")?.to_owned();
    Ok((server, address))
}

/// Waits until the listing of room demo is as `is_so` wants it.
fn wait_for_room(address: &str, is_so: impl Fn(&serde_json::Value) -> bool) -> Result<()> {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        let mut stream = TcpStream::connect(address)?;
        write!(stream, "GET /api/rooms HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let (_, body) = answer.split_once("\r\n\r\n").context("an answer has a head")?;
        let list: serde_json::Value = serde_json::from_str(body)?;
        if list["rooms"].as_array().context("a list")?.iter().any(|room| room["name"] == "demo" && is_so(room)) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    anyhow::bail!("the room does not become as it should")
}

fn a_session_that_is_served_and_sent_is_filmed() -> Result<()> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("live");
    // It is there from the run before, or it is not.
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder)?;
    // Four seconds of the built-in session, with wide expressions.
    let session = std::fs::read_to_string(root().join("shared/assets/demo.ibug68.jsonl"))?;
    let lines: Vec<&str> = session.lines().take(1).chain(session.lines().skip(250).take(100)).collect();
    let feed = folder.join("feed.jsonl");
    std::fs::write(&feed, lines.join("\n"))?;

    let (_server, address) = serve()?;
    let url = format!("ws://{address}");
    let film = Command::new(program("rhytid-client")?)
        .args(["film", &url, "--room", "demo", "--size", "96x96", "--seconds", "60", "--out"])
        .arg(&folder)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()?;
    let film = Running(film);
    wait_for_room(&address, |room| room["viewers"] == 1)?;
    let send = Command::new(program("rhytid-server")?)
        .arg("send")
        .arg(&feed)
        .args(["--to", &url, "--room", "demo"])
        .stderr(Stdio::piped())
        .spawn()?;
    Running(send).finish("send")?;
    film.finish("film")?;

    let decoder = image::codecs::gif::GifDecoder::new(BufReader::new(std::fs::File::open(folder.join("face.gif"))?))?;
    let frames = image::AnimationDecoder::into_frames(decoder).collect_frames()?;
    let first = frames.first().context("a film has pictures")?.buffer();
    // A background and a face: not one colour.
    let corner = first.get_pixel(0, 0);
    ensure!(first.pixels().filter(|pixel| *pixel != corner).count() > 500, "the first picture is empty");
    let differing = frames.iter().filter(|frame| frame.buffer() != first).count();
    ensure!(differing >= 3, "the face moves in {differing} of {} pictures", frames.len());
    let sheet = image::open(folder.join("contact-sheet.png"))?;
    ensure!(sheet.width() > 500 && sheet.height() > 300, "a sheet of {} x {}", sheet.width(), sheet.height());
    Ok(())
}

fn the_tracker_of_the_readme_moves_a_face() -> Result<()> {
    let readme = std::fs::read_to_string(root().join("README.md"))?;
    let (_, code) = readme.split_once("```python\n").context("the README has a tracker in Python")?;
    let (code, _) = code.split_once("```").context("which ends")?;
    let (_server, address) = serve()?;
    ensure!(code.contains("127.0.0.1:7878"), "it names the default address");
    let tracker = Command::new("python3").args(["-c", &code.replace("127.0.0.1:7878", &address)]).stdout(Stdio::null()).spawn()?;
    let _tracker = Running(tracker);
    wait_for_room(&address, |room| room["publisher"]["source"] == "my tracker" && room["frame"]["seq"].as_u64() >= Some(10))
}
