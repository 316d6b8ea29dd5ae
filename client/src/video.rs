//! Pictures to an MP4, through the `ffmpeg` program where it is installed.

use image::RgbaImage;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// The program that encodes.
const PROGRAM: &str = "ffmpeg";
/// Longest time without a new picture that is filled with the last one, seconds: a recording's pause, not its end of days.
const LONGEST_HOLD: f64 = 600.0;

/// Why there is no video.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// The encoder is not installed.
    #[error("an MP4 needs the program ffmpeg, which is not installed (Debian: apt-get install ffmpeg)")]
    NotInstalled,
    /// The encoder could not be started, or has failed.
    #[error("{path}: {problem}")]
    Failed {
        /// The video.
        path: PathBuf,
        /// In the encoder's words, or the system's.
        problem: String,
    },
}

/// A video being encoded: H.264, sRGB pictures as BT.709, a constant rate.
pub struct Video {
    encoder: Child,
    path: PathBuf,
    fps: f64,
    size: [u32; 2],
    /// The picture that shows until the next one, its bytes.
    shown: Option<Vec<u8>>,
    num_written: u64,
}

impl Video {
    /// Begins the video at `path`, which is overwritten; pictures have `size`, `fps` of them a second.
    pub fn create(path: &Path, size: [u32; 2], fps: f64) -> Result<Self, VideoError> {
        let encoder = Command::new(PROGRAM)
            .args(["-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgba"])
            .args(["-video_size", &format!("{}x{}", size[0], size[1]), "-framerate", &fps.to_string(), "-i", "-"])
            // Half as many colours as pixels, which players expect, need even sides.
            .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"])
            .args(["-c:v", "libx264", "-crf", "18", "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1"])
            .args(["-movflags", "+faststart", "-f", "mp4"])
            .arg(path)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| match error.kind() {
                ErrorKind::NotFound => VideoError::NotInstalled,
                _ => VideoError::Failed { path: path.to_owned(), problem: format!("{PROGRAM}: {error}") },
            })?;
        Ok(Self { encoder, path: path.to_owned(), fps, size, shown: None, num_written: 0 })
    }

    /// Shows `picture` from `at` on, counted from the beginning; the one before is repeated until then.
    pub fn add(&mut self, picture: &RgbaImage, at: Duration) -> Result<(), VideoError> {
        self.hold_until(at)?;
        assert_eq!([picture.width(), picture.height()], self.size, "all pictures of a video have one size");
        self.shown = Some(picture.as_raw().clone());
        Ok(())
    }

    /// Ends the video; the last picture is shown until `at`, once at least.
    pub fn finish(mut self, at: Duration) -> Result<(), VideoError> {
        self.hold_until(at)?;
        if self.num_written == 0 {
            self.write_shown()?;
        }
        drop(self.encoder.stdin.take());
        self.conclude()
    }

    fn hold_until(&mut self, at: Duration) -> Result<(), VideoError> {
        let due = (at.as_secs_f64() * self.fps).round() as u64;
        let due = due.min(self.num_written + (LONGEST_HOLD * self.fps) as u64);
        while self.shown.is_some() && self.num_written < due {
            self.write_shown()?;
        }
        Ok(())
    }

    fn write_shown(&mut self) -> Result<(), VideoError> {
        let (Some(pixels), Some(input)) = (&self.shown, &mut self.encoder.stdin) else { return Ok(()) };
        if input.write_all(pixels).is_err() {
            // It says itself why it has hung up.
            self.conclude()?;
            return Err(VideoError::Failed { path: self.path.clone(), problem: format!("{PROGRAM} ended early") });
        }
        self.num_written += 1;
        Ok(())
    }

    /// Waits for the encoder's end.
    fn conclude(&mut self) -> Result<(), VideoError> {
        drop(self.encoder.stdin.take());
        let mut said = String::new();
        if let Some(errors) = &mut self.encoder.stderr {
            // A few lines; more would be no error but a flood.
            let _ = errors.take(16 << 10).read_to_string(&mut said);
        }
        let failed = |problem: String| VideoError::Failed { path: self.path.clone(), problem };
        match self.encoder.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(failed(format!("{PROGRAM}: {}", said.lines().next().unwrap_or(&status.to_string())))),
            Err(error) => Err(failed(error.to_string())),
        }
    }
}

impl Drop for Video {
    /// A video that was not finished leaves no encoder behind.
    fn drop(&mut self) {
        if self.encoder.stdin.take().is_some() {
            let _ = self.encoder.kill();
            let _ = self.encoder.wait();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Needs ffmpeg, else there is nothing to test but the error.
    #[test]
    fn pictures_become_a_video_of_their_length() {
        let path = std::env::temp_dir().join(format!("rhytid-video-{}.mp4", std::process::id()));
        let mut video = match Video::create(&path, [33, 20], 25.0) {
            Err(VideoError::NotInstalled) => return,
            made => made.expect("ffmpeg starts"),
        };
        for i in 0..10u8 {
            let picture = RgbaImage::from_pixel(33, 20, image::Rgba([25 * i, 100, 50, 255]));
            video.add(&picture, Duration::from_millis(100 * u64::from(i))).expect("it takes pictures");
        }
        assert_eq!(video.num_written, 23, "0.9 s at 25 a second, the first from the beginning on");
        video.finish(Duration::from_secs(1)).expect("it ends");
        let bytes = std::fs::read(&path).expect("there is a file");
        assert!(bytes.len() > 500 && &bytes[4..8] == b"ftyp", "{} bytes", bytes.len());
        let _ = std::fs::remove_file(&path);
        let nowhere = Video::create(Path::new("/no/such/folder/x.mp4"), [32, 20], 25.0).expect("it starts");
        assert!(nowhere.finish(Duration::ZERO).expect_err("it cannot be written").to_string().contains("No such file"));
    }
}
