//! `gallery`: the figures of both papers drawn again with this renderer, as sheets of pictures and one page that shows
//! them all. [D09] is Dutreve, Meyer, Bouakaz 2009; [J11] is Jimenez, Echevarria, Oat, Gutierrez 2011.

mod bones;
mod easel;
mod maps;
mod timing;
mod zones;

use crate::render_cli::PictureError;
use crate::sheet::Sheet;
use easel::Easel;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// What to draw.
#[derive(Debug, Clone, clap::Args)]
pub struct GalleryArgs {
    /// Folder for the sheets and index.html; made if it is not there
    #[arg(long, value_name = "DIR", default_value = "target/gallery")]
    pub out: PathBuf,
    /// Only sheets whose name contains this; may be repeated
    #[arg(long, value_name = "NAME")]
    pub only: Vec<String>,
    /// Feed of landmarks for the sheet that shows a tracker's frames
    #[arg(long, value_name = "FEED.jsonl", default_value = "shared/assets/demo.ibug68.jsonl")]
    pub feed: PathBuf,
    /// Character file; the built-in one where none is given
    #[arg(long, value_name = "FILE.glb")]
    pub character: Option<PathBuf>,
    /// Pictures are drawn this many times as large a side and averaged, 1 to 4
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=4))]
    pub supersample: u32,
}

type Result<T> = std::result::Result<T, PictureError>;

/// A sheet of the gallery: its file's name without the ending, a line for the page, and what makes it.
type Plan = (&'static str, &'static str, fn(&mut Easel) -> Result<Sheet>);

const PLANS: [Plan; 15] = [
    ("d09-fig2-skin-influence", "[D09] Figure 2: how far two bones of the right brow reach, and where their pose shows.", bones::reach),
    ("d09-fig3-tracker", "[D09] Figure 3: frames of a 2D tracker and the face they give.", bones::tracker),
    ("d09-fig4-poses", "[D09] Figure 4: faces without wrinkles, with the poses' influence as colour, and with wrinkles.", bones::poses),
    ("d09-fig5-halves", "[D09] Figure 5: the right half of the forehead alone, then all of it, without any mask map.", bones::halves),
    ("j11-fig1-1-with-and-without", "[J11] Figure 1.1: the same face without and with the wrinkles of its zones.", zones::with_and_without),
    ("j11-fig1-2-complex", "[J11] Figure 1.2: one expression of many shapes at once.", zones::complex),
    ("j11-fig1-3-masks-and-maps", "[J11] Figure 1.3: base map, wrinkle map, masks, and what they give.", maps::masks_and_maps),
    ("j11-fig1-4-difference", "[J11] Figure 1.4: the difference map, and the face it gives.", maps::differences),
    ("j11-fig1-5-opposed", "[J11] Figure 1.5: surprise folds the forehead, anger takes the folds back.", zones::opposed),
    ("j11-fig1-6-close-ups", "[J11] Figure 1.6: nose, forehead and chin from near.", zones::close_ups),
    ("j11-fig1-7-sequence", "[J11] Figure 1.7: from neutral to surprise to disgust.", zones::sequence),
    ("j11-table1-1-expressions", "[J11] Table 1.1: the six expressions with the weights of their zones.", zones::table),
    ("both-papers", "The wrinkles of both papers on the same expressions.", zones::both_papers),
    ("j11-timing", "[J11] 1.2.1: partial derivatives against differences of normals, timed.", timing::derivatives_against_differences),
    ("seven-emotions", "Seven emotions under two set-ups of light.", zones::emotions),
];

/// Draws the gallery and gives the path of its page.
pub fn run(args: &GalleryArgs) -> Result<PathBuf> {
    std::fs::create_dir_all(&args.out).map_err(|source| io_error(&args.out, source))?;
    let mut easel = Easel::open(args.character.as_deref(), &args.feed, args.supersample)?;
    for (name, line, plan) in PLANS.iter().filter(|(name, ..)| args.only.is_empty() || args.only.iter().any(|part| name.contains(part))) {
        let sheet = plan(&mut easel)?;
        let path = args.out.join(format!("{name}.png"));
        let (device, queue) = easel.device();
        let picture = image::DynamicImage::ImageRgba8(sheet.draw(device, queue)?).into_rgb8();
        picture.save(&path).map_err(|source| PictureError::Write { path: path.display().to_string(), source })?;
        println!("{}: {line}", path.display());
    }
    let path = args.out.join("index.html");
    std::fs::write(&path, page(|name| args.out.join(format!("{name}.png")).exists())).map_err(|source| io_error(&path, source))?;
    Ok(path)
}

/// One page with every sheet that is there.
fn page(is_there: impl Fn(&str) -> bool) -> String {
    let mut page = String::from(
        "<!doctype html>\n<html lang=\"en\">\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" content=\"width=device-width\">\n\
         <title>Rhytid: the papers' figures, again</title>\n\
         <style>body{margin:2rem auto;max-width:90rem;padding:0 1rem;background:#17181b;color:#ece9e4;font:16px/1.5 sans-serif}\
         img{display:block;max-width:100%;height:auto;margin:.5rem 0 3rem}p{margin:0;color:#93918c}</style>\n\
         <h1>The papers' figures, again</h1>\n",
    );
    for (name, line, _) in PLANS.iter().filter(|(name, ..)| is_there(name)) {
        // Writing to a string cannot fail.
        let _ = writeln!(page, "<p>{line}</p>\n<a href=\"{name}.png\"><img src=\"{name}.png\" alt=\"{line}\"></a>");
    }
    page.push_str("</html>\n");
    page
}

fn io_error(path: &Path, source: std::io::Error) -> PictureError {
    PictureError::Io { path: path.display().to_string(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn page_shows_the_sheets_that_are_there_and_no_others() {
        let page = page(|name| name.starts_with("d09"));
        assert_eq!(page.matches("<img").count(), 4);
        assert!(page.contains("src=\"d09-fig5-halves.png\"") && !page.contains("j11"));
    }
}
