//! Takes what trackers see, moves a character's bones with it and streams the solved frames to viewers.

pub mod feed;
pub mod solve;
