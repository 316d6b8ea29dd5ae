//! Three nodes and a real `nats-server`: one face for all of them, whichever dies, stops or is cut off. Where there is no
//! `nats-server`, all of it shows as ignored.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

fn main() -> std::process::ExitCode {
    #[cfg(target_os = "linux")]
    return linux::main();
    #[cfg(not(target_os = "linux"))]
    std::process::ExitCode::SUCCESS
}

// The folder of this file is the module's, too.
#[cfg(target_os = "linux")]
#[path = "."]
mod linux {
    mod admission;
    #[path = "../process/http.rs"]
    mod http;
    mod namespace;
    mod nats;
    mod nats_cluster;
    mod nodes;
    mod outages;
    #[path = "../process/mod.rs"]
    mod process;
    mod recordings;
    mod replicas;
    mod rooms;
    mod senders;
    #[path = "../process/signal.rs"]
    mod signal;
    #[path = "../process/socket.rs"]
    mod socket;
    mod strangers;
    #[path = "../process/viewer.rs"]
    mod viewer;
    mod watch;

    use libtest_mimic::{Arguments, Trial};
    use std::process::{ExitCode, Stdio};

    pub fn main() -> ExitCode {
        let has_nats = nats::nats_server().arg("--version").stdout(Stdio::null()).status().is_ok();
        if !has_nats {
            println!("no nats-server on this machine (Debian: apt-get install nats-server): the cluster's tests are ignored");
        }
        let trial = |name: &str, test: fn()| {
            Trial::test(name, move || {
                test();
                Ok(())
            })
            .with_ignored_flag(!has_nats)
        };
        let trials = vec![
            trial("viewers_at_all_nodes_get_the_same_packets", rooms::viewers_at_all_nodes_get_the_same_packets),
            trial("late_viewer_elsewhere_gets_the_newest_face_at_once", rooms::late_viewer_elsewhere_gets_the_newest_face_at_once),
            trial("room_has_one_publisher_in_the_whole_cluster", rooms::room_has_one_publisher_in_the_whole_cluster),
            trial("frames_that_nobody_watches_elsewhere_stay_at_home", rooms::unwatched_elsewhere),
            trial("hello_that_leads_to_nothing_takes_no_room_from_anybody", rooms::hello_that_leads_to_nothing),
            trial("face_is_back_with_its_neutral_when_its_node_is_killed", outages::face_is_back_with_its_neutral_when_its_node_is_killed),
            trial("face_is_back_when_its_node_is_stopped_and_nothing_old_comes_when_it_goes_on", outages::stopped_node),
            trial("own_rooms_go_on_without_nats_and_all_joins_again_when_it_is_back", outages::nats_dies),
            trial("neutral_face_found_without_nats_is_kept_when_it_is_back", outages::neutral_without_nats),
            trial("neutral_face_is_kept_again_when_nats_is_back_without_data", outages::neutral_without_data),
            trial("room_opened_at_two_nodes_without_nats_has_one_home_when_it_is_back", outages::two_homes),
            trial("node_that_starts_without_nats_takes_no_room_that_lives", outages::late_node),
            trial("node_that_ends_takes_no_room_that_it_was_asking_for", outages::leaves_while_it_asks),
            trial("publisher_that_comes_while_its_node_ends_is_told_to_come_back", outages::comes_while_it_ends),
            trial("rooms_go_on_whichever_of_three_nats_servers_dies", replicas::three_servers),
            trial("more_replicas_than_nats_servers_are_said_to_be_too_many", replicas::too_few_servers),
            trial("what_no_node_has_written_is_not_believed", strangers::nobodys_messages),
            trial("buckets_of_another_version_get_the_bounds_of_this_one", strangers::other_bounds),
            trial("slow_nats_takes_no_room_from_anybody", strangers::slow_nats),
            trial("lease_that_vanishes_is_claimed_anew_by_its_home", outages::lost_lease),
            trial("rolling_restart_under_load_is_hardly_seen", outages::rolling_restart),
            trial("tracker_over_udp_holds_its_room_before_all_nodes", rooms::tracker_over_udp),
            trial("recording_is_played_at_one_node_for_all", recordings::played_at_one_node_for_all),
            trial("faces_of_another_node_are_recorded", recordings::faces_of_another_node_are_recorded),
            trial("take_goes_on_when_its_room_moves_and_verifies", recordings::take_goes_on_when_its_room_moves),
            trial(
                "recording_that_nobody_asked_for_ends_where_its_room_moves",
                recordings::recording_that_nobody_asked_for_ends_where_its_room_moves,
            ),
            trial(
                "recording_that_nobody_asked_for_ends_where_its_empty_room_is_entered_elsewhere",
                recordings::recording_that_nobody_asked_for_ends_where_its_empty_room_is_entered_elsewhere,
            ),
            trial(
                "recording_of_another_nodes_room_is_finished_when_its_node_ends",
                recordings::recording_of_another_nodes_room_is_finished_when_its_node_ends,
            ),
            trial("password_and_certificates_of_nats_are_passed_through", admission::password_and_certificates),
            trial("node_at_all_addresses_is_to_say_which_one_others_tell", admission::advertised_address),
            trial("certificate_of_a_node_is_shown_to_nats", admission::own_certificate),
            trial("credentials_of_an_account_are_passed_through", admission::credentials),
            trial("node_whose_link_is_cut_goes_on_alone_and_joins_again", outages::cut_link)
                .with_ignored_flag(!has_nats || !namespace::Namespace::is_possible()),
        ];
        libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
    }
}
