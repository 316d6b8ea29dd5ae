//! Servers that people come to and leave, for as long as one likes: publishers that stay, are taken over, or fall silent without a
//! word; viewers that read, come and go, or stop reading; and where there is a `nats-server`, two nodes whose NATS is killed and
//! started again and again. Their memory stays flat, nobody sees an older frame after a newer one, and nothing panics.
//!
//! `cargo test --release -p rhytid-server --test soak -- --ignored --nocapture` runs for half an hour each, alone and as a cluster, or
//! for as many seconds as `RHYTID_SOAK_SECONDS` says; the name of one behind it runs that one.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

fn main() -> std::process::ExitCode {
    #[cfg(target_os = "linux")]
    return linux::main();
    // Memory is read as Linux tells it.
    #[cfg(not(target_os = "linux"))]
    std::process::ExitCode::SUCCESS
}

// The folder of this file is the module's, too.
#[cfg(target_os = "linux")]
#[path = "."]
mod linux {
    #[path = "../process/memory.rs"]
    mod memory;
    #[path = "../cluster/nats.rs"]
    mod nats;
    mod peers;
    #[path = "../process/mod.rs"]
    mod process;
    #[path = "../process/socket.rs"]
    mod socket;
    #[path = "../process/viewer.rs"]
    mod viewer;

    use libtest_mimic::{Arguments, Trial};
    use nats::Nats;
    use peers::{Peers, VIEWERS};
    use process::Server;
    use std::process::{ExitCode, Stdio};
    use std::time::{Duration, Instant};

    /// What a server's memory may grow by after the first tenth, in half an hour.
    const MOST_GROWTH: f64 = 0.02;
    /// Looks at the memory, over the time of a soak.
    const LOOKS: u32 = 60;
    /// How long NATS is there between two deaths, and how long it is away: leases end after some seconds without it.
    const NATS_LIVES: Duration = Duration::from_secs(7);
    const NATS_IS_AWAY: Duration = Duration::from_secs(3);

    pub fn main() -> ExitCode {
        let has_nats = nats::nats_server().arg("--version").stdout(Stdio::null()).status().is_ok();
        if !has_nats {
            println!("no nats-server on this machine (Debian: apt-get install nats-server): the cluster's soak is ignored");
        }
        let trial = |name: &str, test: fn()| {
            Trial::test(name, move || {
                test();
                Ok(())
            })
        };
        let trials = vec![
            trial("nobody_sees_an_older_frame_while_others_come_go_and_fall_silent", || drop(soak(Duration::from_secs(12), false))),
            trial("nobody_sees_an_older_frame_while_nats_dies_and_comes_back", || drop(soak(Duration::from_secs(24), true)))
                .with_ignored_flag(!has_nats),
            trial("memory_stays_flat_for_half_an_hour", || stays_flat(false)).with_ignored_flag(true),
            trial("memory_of_a_cluster_stays_flat_for_half_an_hour", || stays_flat(true)).with_ignored_flag(true),
        ];
        let mut arguments = Arguments::from_args();
        // Each of them would be load for the others.
        arguments.test_threads = Some(1);
        libtest_mimic::run(&arguments, trials).exit_code()
    }

    /// Runs for `time`; the memory of each server at each look, bytes.
    fn soak(time: Duration, is_cluster: bool) -> Vec<Vec<u64>> {
        let mut nats = is_cluster.then(Nats::start);
        let args = ["serve", "--publisher-timeout", "3", "--viewer-timeout", "6", "--write-timeout", "6"];
        let mut args = [&args[..], &["--ping-interval", "1", "--room-timeout", "2"]].concat();
        let url = nats.as_ref().map(Nats::url);
        if let Some(url) = &url {
            args.extend(["--cluster", url]);
        }
        let mut servers: Vec<Server> = (0..if is_cluster { 2 } else { 1 }).map(|_| Server::start(&args)).collect();
        let mut memory = vec![Vec::new(); servers.len()];
        let peers = Peers::start(servers.iter().map(|server| server.address.clone()).collect());
        let (start, mut num_deaths) = (Instant::now(), 0);
        // When NATS dies or comes back.
        let mut turn = NATS_LIVES;
        for look in 1..=LOOKS {
            while start.elapsed() < time * look / LOOKS {
                std::thread::sleep(Duration::from_millis(50));
                if let Some(nats) = nats.as_mut().filter(|_| start.elapsed() >= turn) {
                    nats.kill();
                    num_deaths += 1;
                    std::thread::sleep(NATS_IS_AWAY);
                    nats.restart();
                    turn = start.elapsed() + NATS_LIVES;
                }
            }
            for (server, memory) in servers.iter().zip(&mut memory) {
                memory.push(memory::resident(&server.process));
            }
            let mib: Vec<String> =
                memory.iter().map(|memory| format!("{:.2} MiB", memory[memory.len() - 1] as f64 / f64::from(1 << 20))).collect();
            println!("{:.0} s: {}, {peers}, {num_deaths} deaths of NATS", start.elapsed().as_secs_f64(), mib.join(" and "));
            if peers.are_broken() {
                break;
            }
        }
        let seen = peers.finish();
        for server in &mut servers {
            server.kill();
            let said = server.log();
            assert!(!said.contains("panicked"), "{said}");
        }
        assert!(seen.frames > 1000 && seen.joins > u64::from(VIEWERS), "{seen:?}");
        assert!(!is_cluster || num_deaths > 1, "NATS died {num_deaths} times");
        memory
    }

    fn stays_flat(is_cluster: bool) {
        let seconds = std::env::var("RHYTID_SOAK_SECONDS").ok().map_or(1800, |text| text.parse().expect("a number of seconds"));
        for memory in soak(Duration::from_secs(seconds), is_cluster) {
            // What is held at a moment goes up and down with who is there: the mean of the second tenth against that of the last.
            let tenth = memory.len() / 10;
            let mean = |part: &[u64]| part.iter().sum::<u64>() / part.len() as u64;
            let (early, late) = (mean(&memory[tenth..2 * tenth]), mean(&memory[memory.len() - tenth..]));
            println!("{early} bytes early, {late} bytes late");
            assert!(late as f64 <= early as f64 * (1.0 + MOST_GROWTH), "{early} bytes have become {late}");
        }
    }
}
