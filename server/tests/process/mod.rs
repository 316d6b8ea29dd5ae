//! Servers that tests start as processes of their own. What is here, every test with such a server uses; each file beside this one
//! holds what only some of them need, and those include it by its path.

use std::io::{BufRead, BufReader, Read};
use std::ops::{Deref, DerefMut};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Longer than anything here takes; a test that waits for it has failed.
pub const PATIENCE: Duration = Duration::from_secs(15);

/// The program, whatever the environment of the tests says about logs and tokens.
pub fn program(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rhytid-server"));
    command.args(args).env_remove("RUST_LOG").env_remove("RHYTID_TOKEN");
    command
}

/// Waits until there is what `find` looks for.
pub fn wait_for<T>(what: &str, mut find: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = find() {
            return found;
        }
        assert!(start.elapsed() < PATIENCE, "{what} does not come");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// A process that ends with the test.
pub struct Process(Child);

impl Process {
    pub fn start(command: &mut Command) -> Self {
        Self(command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}")))
    }
}

impl Deref for Process {
    type Target = Child;

    fn deref(&self) -> &Child {
        &self.0
    }
}

impl DerefMut for Process {
    fn deref_mut(&mut self) -> &mut Child {
        &mut self.0
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A server that ends with the test. Of every one holds: it prints one line, and it does not panic.
pub struct Server {
    pub process: Process,
    /// Where it can be reached from here, `host:port`.
    pub address: String,
    stdout: Text,
    stderr: Text,
}

impl Server {
    /// Runs `args`, a command that serves; at a free port of this machine unless they say where. It can be connected to.
    pub fn start(args: &[&str]) -> Self {
        Self::try_start(&[], args).unwrap_or_else(|log| panic!("{args:?} does not serve: {log}"))
    }

    /// As [`Self::start`], by a command that runs the one whose words stand behind its own. Gives the log of a server that ends
    /// before it serves.
    pub fn try_start(runner: &[&str], args: &[&str]) -> Result<Self, String> {
        let mut command = program(args);
        if let [runner, words @ ..] = runner {
            let inner = std::mem::replace(&mut command, Command::new(runner));
            command.args(words).arg(inner.get_program()).args(inner.get_args());
            for (name, _) in inner.get_envs() {
                command.env_remove(name);
            }
        }
        if !args.contains(&"--listen") {
            command.args(["--listen", "127.0.0.1:0"]);
        }
        let mut process = Process::start(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
        let stdout = Text::read(process.stdout.take().expect("piped"));
        let stderr = Text::read(process.stderr.take().expect("piped"));
        let mut server = Self { process, address: String::new(), stdout, stderr };
        let line = wait_for("its first line", || {
            let is_over = server.stdout.is_over();
            let line = server.stdout.so_far().lines().next().map(str::to_owned);
            line.map(Some).or(is_over.then_some(None))
        });
        let Some(line) = line else {
            server.kill();
            return Err(server.log());
        };
        let address = line.strip_prefix("listening on http://").unwrap_or_else(|| panic!("its first line is {line:?}"));
        server.address = address.replace("0.0.0.0:", "127.0.0.1:");
        Ok(server)
    }

    /// What it has logged so far; all of it once it is killed.
    pub fn log(&self) -> String {
        self.stderr.so_far()
    }

    /// Kills it if it has not ended by itself.
    pub fn kill(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
        self.stdout.finish();
        self.stderr.finish();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
        let log = self.log();
        if std::thread::panicking() {
            let lines: Vec<&str> = log.lines().collect();
            eprintln!("the last that the server at {} logged:\n{}", self.address, lines[lines.len().saturating_sub(50)..].join("\n"));
            return;
        }
        assert!(!log.contains("panicked"), "{log}");
        let printed = self.stdout.so_far();
        assert!(printed.lines().count() <= 1, "standard output has one line, not {printed:?}");
    }
}

/// What comes out of a pipe, read as it comes: nobody who writes into it has to wait.
struct Text {
    text: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
}

impl Text {
    fn read(pipe: impl Read + Send + 'static) -> Self {
        let text = Arc::new(Mutex::new(String::new()));
        let reader = std::thread::spawn({
            let (text, mut pipe) = (text.clone(), BufReader::new(pipe));
            move || {
                let mut line = Vec::new();
                while pipe.read_until(b'\n', &mut line).is_ok_and(|length| length > 0) {
                    text.lock().unwrap().push_str(&String::from_utf8_lossy(&line));
                    line.clear();
                }
            }
        });
        Self { text, reader: Some(reader) }
    }

    fn so_far(&self) -> String {
        self.text.lock().unwrap().clone()
    }

    fn is_over(&self) -> bool {
        self.reader.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits for the end of the pipe.
    fn finish(&mut self) {
        if let Some(reader) = self.reader.take() {
            reader.join().expect("reading does not panic");
        }
    }
}
