//! Expressions that a publisher names, as far as the zones a viewer sees.

use super::harness::Server;
use rhytid_server::load_character;

/// The most a packet's rounding to 8 bits changes a zone.
const STEP: f32 = 0.5 / 255.0 + 1e-6;

#[test]
fn zones_follow_the_characters_table_and_an_unknown_name_is_told_those_there_are() {
    let (character, _) = load_character(None).unwrap();
    let zones = character.zones.as_ref().expect("the built-in character has zones");
    let row = |name: &str| &zones.expressions.iter().find(|row| row.name == name).expect("the table has it").weights;
    let server = Server::start();
    let mut viewer = server.json_viewer("demo");
    assert_eq!(viewer.hello.character.zones, zones.list.iter().map(|zone| zone.name.clone()).collect::<Vec<_>>());
    let mut publisher = server.ready_publisher("demo");
    let mut seq = 0;
    for (expressions, sums) in [
        (r#"{"surprise":0.8}"#, row("surprise").iter().map(|surprise| 0.8 * surprise).collect::<Vec<_>>()),
        // What anger takes back is taken back before anything is cut off.
        (r#"{"surprise":1,"anger":0.5}"#, row("surprise").iter().zip(row("anger")).map(|(a, b)| a + 0.5 * b).collect()),
        ("{}", vec![0.0; zones.list.len()]),
    ] {
        let frame = loop {
            let t = f64::from(seq) * 0.04;
            publisher.send(&format!(r#"{{"type":"frame","t":{t},"expressions":{expressions}}}"#));
            seq += 1;
            let frame = viewer.next_json();
            assert_eq!(frame.seq + 1, seq);
            // A second, by which any blend is over.
            if seq % 25 == 0 {
                break frame;
            }
        };
        assert!(expressions == "{}" || sums.iter().any(|sum| *sum > 0.3), "the table says nothing of {expressions}");
        for (zone, (got, sum)) in zones.list.iter().zip(frame.zones.iter().zip(&sums)) {
            let wanted = sum.clamp(0.0, 1.0);
            assert!((got - wanted).abs() <= STEP, "{expressions}: zone {} is {got}, expected {wanted}", zone.name);
        }
    }
    let t = f64::from(seq) * 0.04;
    publisher.send(&format!(r#"{{"type":"frame","t":{t},"expressions":{{"suprise":0.8}}}}"#));
    let (code, message) = publisher.error();
    let names: Vec<&str> = zones.expressions.iter().map(|row| row.name.as_str()).collect();
    assert_eq!(code, "unknown_expression");
    let wanted = format!("field expressions.suprise is no expression of this character, expected {}", names.join(", "));
    assert_eq!(message, wanted);
    publisher.send(&format!(r#"{{"type":"frame","t":{t},"expressions":{{"surprise":0.8}}}}"#));
    assert_eq!(viewer.next_json().seq, seq, "the session goes on, and the bad frame counts for nothing");
}
