//! How strongly each wrinkle zone shows (Jimenez, Echevarria, Oat, Gutierrez 2011): expressions by the character's table,
//! summed with their signs and clamped once, so that negative weights take back what other expressions ask for.

use super::expressions::{Emotion, EmotionReader};
use super::weights_to_bones::Weights;
use rhytid_shared::Character;
use rhytid_shared::character::{BridgeRow, Side};
use rhytid_shared::limits::{MAX_EXPRESSIONS, MAX_ZONES};

/// How much of each expression of the character's table the left and the right half of the face show.
pub(super) type Amounts = [[f32; 2]; MAX_EXPRESSIONS];

/// The zones of a character.
pub(super) struct ZoneRig {
    /// Of each zone.
    sides: Vec<Option<Side>>,
    /// `weights[e * z + zone]`.
    weights: Vec<f32>,
    /// Of each row of the table, where a tracker's weights say something about it.
    emotions: Vec<Option<Emotion>>,
    reader: EmotionReader,
    bridge: Vec<BridgeRow>,
    num_bones: usize,
    can_stretch: bool,
}

impl ZoneRig {
    /// `None` for a character without zones.
    pub(super) fn new(character: &Character) -> Option<Self> {
        let zones = character.zones.as_ref()?;
        Some(Self {
            sides: zones.list.iter().map(|zone| zone.side).collect(),
            weights: zones.expressions.iter().flat_map(|expression| &expression.weights).copied().collect(),
            emotions: zones.expressions.iter().map(|expression| Emotion::from_name(&expression.name)).collect(),
            reader: EmotionReader::new(),
            bridge: zones.bridge.clone(),
            num_bones: character.num_bones(),
            can_stretch: zones.stretch.is_some(),
        })
    }

    /// Expressions as a publisher gives them: alike on both halves.
    pub(super) fn given(amounts: &[f32; MAX_EXPRESSIONS]) -> Amounts {
        amounts.map(|amount| [amount; 2])
    }

    /// Expressions by a tracker's weights; `None` where the table has none that they say anything about.
    pub(super) fn read(&self, weights: &Weights) -> Option<Amounts> {
        let mut amounts = [[0.0; 2]; MAX_EXPRESSIONS];
        let mut is_known = false;
        for (amounts, emotion) in amounts.iter_mut().zip(&self.emotions) {
            let Some(emotion) = *emotion else { continue };
            *amounts = [Side::Left, Side::Right].map(|side| self.reader.amount(emotion, side, weights));
            is_known = true;
        }
        is_known.then_some(amounts)
    }

    /// Writes how strongly each zone shows and how far it is stretched, both in `[0, 1]`: by expressions, and by the influences
    /// (pose-major) times `bridge`.
    pub(super) fn write(&self, amounts: &Amounts, bridge: f32, influences: &[f32], zones: &mut [f32], stretched: &mut [f32]) {
        let mut sums = [0.0_f32; MAX_ZONES];
        self.sum_expressions(amounts, &mut sums);
        if bridge != 0.0 {
            for row in &self.bridge {
                sums[row.zone] += bridge * row.gain * influences[row.pose * self.num_bones + row.bone];
            }
        }
        for (zone, sum) in zones.iter_mut().zip(sums) {
            *zone = sum.clamp(0.0, 1.0);
        }
        for (zone, sum) in stretched.iter_mut().zip(sums) {
            *zone = if self.can_stretch { (-sum).clamp(0.0, 1.0) } else { 0.0 };
        }
    }

    fn sum_expressions(&self, amounts: &Amounts, sums: &mut [f32; MAX_ZONES]) {
        for ([left, right], row) in amounts.iter().zip(self.weights.chunks_exact(self.sides.len())) {
            for ((sum, weight), side) in sums.iter_mut().zip(row).zip(&self.sides) {
                let amount = match side {
                    Some(Side::Left) => *left,
                    Some(Side::Right) => *right,
                    None => 0.5 * (left + right),
                };
                *sum += amount * weight;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's eight zones and its Table 1.1.
    fn paper() -> ZoneRig {
        const TABLE: [(&str, [f32; 8]); 6] = [
            ("joy", [1.0, 1.0, 0.2, 0.2, 0.0, 0.0, 0.0, 0.0]),
            ("surprise", [0.8, 0.8, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0]),
            ("fear", [0.2, 0.2, 0.75, 0.75, 0.3, 0.3, 0.0, 0.6]),
            ("anger", [-0.6, -0.6, -0.8, -0.8, 0.8, 0.8, 1.0, 0.0]),
            ("disgust", [0.0, 0.0, -0.1, -0.1, 1.0, 1.0, 1.0, 0.5]),
            ("sad", [0.2, 0.2, 0.75, 0.75, 0.0, 0.0, 0.1, 1.0]),
        ];
        let (left, right) = (Some(Side::Left), Some(Side::Right));
        ZoneRig {
            sides: vec![left, right, left, right, left, right, None, None],
            weights: TABLE.iter().flat_map(|(_, weights)| *weights).collect(),
            emotions: TABLE.iter().map(|(name, _)| Emotion::from_name(name)).collect(),
            reader: EmotionReader::new(),
            bridge: Vec::new(),
            num_bones: 0,
            can_stretch: false,
        }
    }

    /// Zones and stretches under `(row of the table, left, right)`.
    fn show(rig: &ZoneRig, expressions: &[(usize, f32, f32)]) -> ([f32; 8], [f32; 8]) {
        let mut amounts = [[0.0; 2]; MAX_EXPRESSIONS];
        expressions.iter().for_each(|&(row, left, right)| amounts[row] = [left, right]);
        let (mut zones, mut stretched) = ([9.0; 8], [9.0; 8]);
        rig.write(&amounts, 0.0, &[], &mut zones, &mut stretched);
        (zones, stretched)
    }

    #[track_caller]
    fn assert_near(got: [f32; 8], want: [f32; 8]) {
        assert!(got.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-5), "got {got:?}, expected {want:?}");
    }

    const JOY: usize = 0;
    const SURPRISE: usize = 1;
    const ANGER: usize = 3;
    const DISGUST: usize = 4;
    const SAD: usize = 5;

    #[test]
    fn anger_takes_back_the_forehead_of_surprise() {
        // Clamped before the sum, anger would leave the forehead at 0.8.
        let (zones, stretched) = show(&paper(), &[(SURPRISE, 1.0, 1.0), (ANGER, 1.0, 1.0)]);
        assert_near(zones, [0.2, 0.2, 0.0, 0.0, 0.8, 0.8, 1.0, 0.0]);
        assert_eq!(stretched, [0.0; 8]);
    }

    #[test]
    fn sums_are_clamped_once() {
        let rig = paper();
        assert_near(show(&rig, &[(ANGER, 1.0, 1.0)]).0, [0.0, 0.0, 0.0, 0.0, 0.8, 0.8, 1.0, 0.0]);
        assert_near(show(&rig, &[(JOY, 1.0, 1.0), (SURPRISE, 1.0, 1.0)]).0, [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        let three = [(DISGUST, 0.5, 0.5), (ANGER, 0.5, 0.5), (SAD, 0.3, 0.3)];
        assert_near(show(&rig, &three).0, [0.0, 0.0, 0.0, 0.0, 0.9, 0.9, 1.0, 0.55]);
    }

    #[test]
    fn what_is_below_zero_stretches_where_there_is_a_map_for_it() {
        let rig = ZoneRig { can_stretch: true, ..paper() };
        let (zones, stretched) = show(&rig, &[(DISGUST, 0.5, 0.5), (ANGER, 0.5, 0.5), (SAD, 0.3, 0.3)]);
        assert_near(zones, [0.0, 0.0, 0.0, 0.0, 0.9, 0.9, 1.0, 0.55]);
        assert_near(stretched, [0.24, 0.24, 0.225, 0.225, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn halves_show_apart_and_the_middle_shows_their_mean() {
        assert_near(show(&paper(), &[(ANGER, 0.5, 0.0)]).0, [0.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.25, 0.0]);
    }

    #[test]
    fn influences_drive_zones_where_nothing_is_known_of_expressions() {
        let row = |pose, bone, zone, gain| BridgeRow { pose, bone, zone, gain };
        let bridge = vec![row(0, 0, 0, 0.5), row(0, 1, 0, 0.5), row(1, 2, 0, -1.0), row(1, 2, 6, 2.0)];
        let rig = ZoneRig { bridge, num_bones: 3, can_stretch: true, ..paper() };
        let (mut zones, mut stretched) = ([9.0; 8], [9.0; 8]);
        rig.write(&[[0.0; 2]; MAX_EXPRESSIONS], 1.0, &[0.8, 0.4, 0.0, 0.0, 0.0, 0.25], &mut zones, &mut stretched);
        assert_near(zones, [0.35, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0]);
        rig.write(&[[0.0; 2]; MAX_EXPRESSIONS], 1.0, &[0.0, 0.0, 0.0, 0.0, 0.0, 0.75], &mut zones, &mut stretched);
        assert_near(zones, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert_near(stretched, [0.75, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_table_of_unknown_names_leaves_weights_to_the_influences() {
        let weights = [0.5; rhytid_shared::NUM_ARKIT_SHAPES];
        assert!(paper().read(&weights).is_some());
        assert!(ZoneRig { emotions: vec![None; 6], ..paper() }.read(&weights).is_none());
    }
}
