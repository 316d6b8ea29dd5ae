//! What wrinkle zones add to a fragment of skin, counted in SPIR-V after optimisation, with less without. Jimenez et al.
//! 2011, 1.2, count nine arithmetic instructions and three texture reads.
//!
//! Needs `spirv-opt` (Debian: `spirv-tools`); a machine without it shows this as ignored.

use anyhow::{Context, ensure};
use libtest_mimic::{Arguments, Trial};
use std::process::{Command, ExitCode};

fn main() -> ExitCode {
    let is_here = Command::new("spirv-opt").arg("--version").output().is_ok();
    let trial = Trial::test("zones_add_at_most_nine_instructions_and_three_reads", || zones().map_err(|error| format!("{error:#}").into()));
    libtest_mimic::run(&Arguments::from_args(), vec![trial.with_ignored_flag(!is_here)]).exit_code()
}

fn zones() -> anyhow::Result<()> {
    let (with, without) = (count(1)?, count(0)?);
    let arithmetic = with.arithmetic - without.arithmetic;
    let reads = with.reads - without.reads;
    println!("zones add {arithmetic} arithmetic instructions and {reads} texture reads to {} and {}", without.arithmetic, without.reads);
    ensure!(reads == 3, "{reads} texture reads");
    ensure!((1..=9).contains(&arithmetic), "{arithmetic} arithmetic instructions");
    Ok(())
}

#[derive(Debug)]
struct Count {
    arithmetic: i64,
    reads: i64,
}

/// Skin drawn with no pose's map, zones blended by their partial derivatives (1) or absent (0).
fn count(zones: u32) -> anyhow::Result<Count> {
    let module = naga::front::wgsl::parse_str(rhytid_shaders::SKIN)?;
    let info = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty()).validate(&module)?;
    let constants = [("ZONES", f64::from(zones)), ("POSES", 0.0)].map(|(name, value)| (name.to_owned(), value));
    let entry = (naga::ShaderStage::Fragment, "fs_wrinkled");
    let (module, info) = naga::back::pipeline_constants::process_overrides(&module, &info, Some(entry), &constants.into_iter().collect())?;
    let pipeline = naga::back::spv::PipelineOptions { shader_stage: entry.0, entry_point: entry.1.to_owned() };
    let words = naga::back::spv::write_vec(&module, &info, &naga::back::spv::Options::default(), Some(&pipeline))?;
    let folder = tempfile::tempdir()?;
    let [raw, optimised] = ["raw.spv", "optimised.spv"].map(|name| folder.path().join(name));
    std::fs::write(&raw, words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>())?;
    let output = Command::new("spirv-opt").args(["-O", "-o"]).arg(&optimised).arg(&raw).output()?;
    ensure!(output.status.success(), "spirv-opt: {}", String::from_utf8_lossy(&output.stderr));
    let bytes = std::fs::read(&optimised)?;
    let words: Vec<u32> = bytes.as_chunks::<4>().0.iter().map(|word| u32::from_le_bytes(*word)).collect();

    let mut count = Count { arithmetic: 0, reads: 0 };
    // Behind the header of five words each instruction begins with its length and its number.
    let mut at = 5;
    while let Some(word) = words.get(at) {
        match word & 0xFFFF {
            // OpExtInst, OpFNegate to OpDot.
            12 | 127 | 129 | 131 | 133 | 136 | 142..=148 => count.arithmetic += 1,
            // OpImageSampleImplicitLod to OpImageFetch.
            87..=95 => count.reads += 1,
            _ => {}
        }
        at += usize::try_from(word >> 16)?.max(1);
    }
    (count.reads > 0).then_some(count).context("no texture is read: the entry was not found")
}
