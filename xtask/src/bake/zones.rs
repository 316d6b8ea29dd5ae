//! The wrinkle zones' description: names, the paper's table, and how poses drive zones where nothing else does.

use rhytid_shared::character::schema::{BridgeRow, Expression, Side, Zone, ZoneMap, Zones};

/// Names and sides in the order of the masks' channels. The paper's colours; which is which follows from its table: pairs of
/// equal weights are halves, sadness has the chin, anger and disgust have nose and glabella.
const ZONES: [(&str, Option<Side>); 8] = [
    ("red", Some(Side::Left)),
    ("green", Some(Side::Right)),
    ("blue", Some(Side::Left)),
    ("brown", Some(Side::Right)),
    ("cyan", Some(Side::Left)),
    ("magenta", Some(Side::Right)),
    ("orange", None),
    ("gray", None),
];

/// Jimenez, Echevarria, Oat, Gutierrez 2011, Table 1.1.
const TABLE: [(&str, [f32; 8]); 6] = [
    ("joy", [1.0, 1.0, 0.2, 0.2, 0.0, 0.0, 0.0, 0.0]),
    ("surprise", [0.8, 0.8, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0]),
    ("fear", [0.2, 0.2, 0.75, 0.75, 0.3, 0.3, 0.0, 0.6]),
    ("anger", [-0.6, -0.6, -0.8, -0.8, 0.8, 0.8, 1.0, 0.0]),
    ("disgust", [0.0, 0.0, -0.1, -0.1, 1.0, 1.0, 1.0, 0.5]),
    ("sad", [0.2, 0.2, 0.75, 0.75, 0.0, 0.0, 0.1, 1.0]),
];

/// Pose, bone and zone (left ones; the right ones are alike), and what influence 1 adds. A raised brow folds the forehead over
/// it; a lowered one smooths it and folds the glabella. Tuned by eye.
const HALF_BRIDGE: [(&str, &str, &str, f32); 8] = [
    ("stretch", "brow_mid_l", "red", 0.5),
    ("stretch", "brow_outer_l", "red", 0.5),
    ("stretch", "brow_inner_l", "blue", 1.0),
    ("compress", "brow_mid_l", "red", -0.6),
    ("compress", "brow_inner_l", "blue", -0.8),
    ("compress", "brow_inner_l", "cyan", 0.6),
    ("compress", "nose_wing_l", "cyan", 0.4),
    ("compress", "brow_inner_l", "orange", 0.25),
];
/// The same for the middle of the face.
const MIDDLE_BRIDGE: [(&str, &str, &str, f32); 2] = [("compress", "glabella", "orange", 0.5), ("pucker", "chin", "gray", 1.0)];

/// The description with the indices of its textures.
pub fn describe(masks: [usize; 2], map: ZoneMap, stretch: ZoneMap, difference: usize) -> Zones {
    Zones {
        list: ZONES.map(|(name, side)| Zone { name: name.to_owned(), side }).to_vec(),
        masks: masks.to_vec(),
        map,
        stretch: Some(stretch),
        difference: Some(difference),
        wavelength: 0.006,
        expressions: TABLE.map(|(name, weights)| Expression { name: name.to_owned(), weights: weights.to_vec() }).to_vec(),
        bridge: bridge(),
    }
}

fn bridge() -> Vec<BridgeRow> {
    let row = |pose: &str, bone: &str, zone: &str, gain| BridgeRow { pose: pose.into(), bone: bone.into(), zone: zone.into(), gain };
    let mut rows = Vec::new();
    for (pose, bone, zone, gain) in HALF_BRIDGE {
        rows.push(row(pose, bone, zone, gain));
        let right_zone = match zone {
            "red" => "green",
            "blue" => "brown",
            "cyan" => "magenta",
            middle => middle,
        };
        rows.push(row(pose, &bone.replace("_l", "_r"), right_zone, gain));
    }
    rows.extend(MIDDLE_BRIDGE.map(|(pose, bone, zone, gain)| row(pose, bone, zone, gain)));
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_halves_are_driven_alike() {
        let rows = bridge();
        let sum = |zone: &str, side: &str| -> f32 {
            rows.iter().filter(|row| row.zone == zone && row.bone.ends_with(side)).map(|row| row.gain).sum()
        };
        for (left, right) in [("red", "green"), ("blue", "brown"), ("cyan", "magenta"), ("orange", "orange")] {
            assert_eq!(sum(left, "_l"), sum(right, "_r"));
        }
        // Neither half reaches over to the other.
        assert!(rows.iter().all(|row| !(row.bone.ends_with("_r") && row.zone == "red")));
        // At a reference pose no zone asks for more than all of its wrinkles.
        for pose in ["stretch", "compress", "pucker"] {
            for (zone, _) in ZONES {
                let all: f32 = rows.iter().filter(|row| row.pose == pose && row.zone == zone).map(|row| row.gain).sum();
                assert!((-1.0..=1.0).contains(&all), "{pose}, {zone}: {all}");
            }
        }
    }

    #[test]
    fn halves_of_a_pair_weigh_alike_in_the_table() {
        for (name, weights) in TABLE {
            assert!((0..3).all(|pair| weights[2 * pair] == weights[2 * pair + 1]), "{name}");
        }
    }
}
