//! Source slots: which parts of a room's face a publisher drives, and what it is called among several.

use super::MessageError;
use crate::names::RoomName;

/// A part of the face that one source of several may drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ChannelGroup {
    /// Brows and forehead.
    Brows,
    /// Eyelids.
    Lids,
    /// Eyes.
    Gaze,
    /// Mouth, nose, cheeks and jaw.
    Mouth,
    /// Head rotation and position.
    Head,
}

impl ChannelGroup {
    /// All of them, in the order of their numbers.
    pub const ALL: [Self; 5] = [Self::Brows, Self::Lids, Self::Gaze, Self::Mouth, Self::Head];

    /// As messages call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Brows => "brows",
            Self::Lids => "lids",
            Self::Gaze => "gaze",
            Self::Mouth => "mouth",
            Self::Head => "head",
        }
    }

    /// The group of this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|group| group.name() == name)
    }

    /// Place in [`Self::ALL`].
    pub fn index(self) -> usize {
        self as usize
    }
}

/// A set of channel groups.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChannelGroups(u8);

impl ChannelGroups {
    /// Every group.
    pub const ALL: Self = Self(0b1_1111);
    /// None at all.
    pub const NONE: Self = Self(0);

    /// True where `group` is one of them.
    pub fn contains(self, group: ChannelGroup) -> bool {
        self.0 & (1 << group.index()) != 0
    }

    /// With `group`, too.
    #[must_use]
    pub fn with(self, group: ChannelGroup) -> Self {
        Self(self.0 | 1 << group.index())
    }

    /// In the order of [`ChannelGroup::ALL`].
    pub fn iter(self) -> impl Iterator<Item = ChannelGroup> {
        ChannelGroup::ALL.into_iter().filter(move |group| self.contains(*group))
    }
}

impl Default for ChannelGroups {
    fn default() -> Self {
        Self::ALL
    }
}

/// The slot that a publisher claims in a room.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Slot {
    /// By the rule of room names.
    pub name: String,
    /// 0 to 100; the highest live one drives a group.
    pub priority: u8,
    /// What it may drive.
    pub groups: ChannelGroups,
}

impl Slot {
    /// The slot of a publisher that names none.
    pub const MAIN: &str = "main";
    /// Priority of a publisher that gives none.
    pub const PRIORITY: u8 = 50;
    /// Highest priority.
    pub const MAX_PRIORITY: u8 = 100;

    /// Checks a slot as a hello gives it.
    pub(super) fn check(name: Option<String>, priority: Option<f64>, groups: Option<ChannelGroups>) -> Result<Self, MessageError> {
        let name = match name {
            Some(name) => RoomName::new(&name).map(|name| name.as_str().to_owned()).map_err(|_| {
                let shown: String = name.chars().take(40).collect();
                MessageError::new("out_of_range", format!("field slot is {shown:?}, expected 1 to 64 characters of A-Z a-z 0-9 _ -"))
            })?,
            None => Self::MAIN.to_owned(),
        };
        let most = f64::from(Self::MAX_PRIORITY);
        let priority = match priority {
            Some(priority) if (0.0..=most).contains(&priority) && priority.fract() == 0.0 => priority as u8,
            Some(priority) => {
                return Err(MessageError::new(
                    "out_of_range",
                    format!("field priority is {priority}, expected a whole number from 0 to {most}"),
                ));
            }
            None => Self::PRIORITY,
        };
        Ok(Self { name, priority, groups: groups.unwrap_or_default() })
    }
}

impl Default for Slot {
    fn default() -> Self {
        Self { name: Self::MAIN.to_owned(), priority: Self::PRIORITY, groups: ChannelGroups::ALL }
    }
}
