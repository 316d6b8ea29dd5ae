//! Sizes of pictures on command lines.

/// Largest side of a picture, pixels: what WebGPU guarantees.
const MAX_SIDE: u32 = 8192;

/// Reads `WIDTHxHEIGHT`, pixels.
pub(crate) fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let expected = || format!("{text:?} is no size, expected WIDTHxHEIGHT in pixels, 1 to {MAX_SIDE} each");
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    let side = |text: &str| text.parse().ok().filter(|side| (1..=MAX_SIDE).contains(side));
    Ok([side(width).ok_or_else(expected)?, side(height).ok_or_else(expected)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_or_refused_with_what_was_expected() {
        assert_eq!(parse_size("512x256"), Ok([512, 256]));
        for bad in ["512", "0x512", "512x", "9000x10", "axb"] {
            assert!(parse_size(bad).is_err_and(|message| message.contains("expected WIDTHxHEIGHT")), "{bad}");
        }
    }
}
