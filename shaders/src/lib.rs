//! Rhytid's WGSL and the layouts reflected from it. One pass is one file under `src/wgsl`; parts that several passes share
//! are included by `//!include NAME`. The build checks every pass with naga and refuses uniform blocks that WebGL2 does not hold.
//! Nothing here knows wgpu or the character.

include!(concat!(env!("OUT_DIR"), "/shaders.rs"));

/// Asserts at compile time that a Rust struct lies in memory as the WGSL struct it is copied into:
/// `assert_layout!(RustType, wgsl_struct_in_snake_case, { field: FIELD, … })`.
#[macro_export]
macro_rules! assert_layout {
    ($rust:ty, $wgsl:ident, { $($field:ident : $offset:ident),* $(,)? }) => {
        const _: () = {
            assert!(::core::mem::size_of::<$rust>() == $crate::layout::$wgsl::SIZE);
            $(assert!(::core::mem::offset_of!($rust, $field) == $crate::layout::$wgsl::$offset);)*
        };
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use naga::ShaderStage;
    use naga::back::glsl;

    fn validated(source: &str) -> (naga::Module, naga::valid::ModuleInfo) {
        let module = naga::front::wgsl::parse_str(source).expect("WGSL parses");
        let info = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
            .validate(&module)
            .expect("WGSL is valid");
        (module, info)
    }

    /// What WebGL2 takes is GLSL ES 3.00: no storage, no compute, no arrays of textures.
    fn write_webgl2(source: &str) -> Result<Vec<String>, String> {
        let (module, info) = validated(source);
        let mut written = Vec::new();
        for entry in &module.entry_points {
            let (module, info) =
                naga::back::pipeline_constants::process_overrides(&module, &info, Some((entry.stage, &entry.name)), &Default::default())
                    .map_err(|error| error.to_string())?;
            let options = glsl::Options { version: glsl::Version::Embedded { version: 300, is_webgl: true }, ..Default::default() };
            let pipeline = glsl::PipelineOptions { shader_stage: entry.stage, entry_point: entry.name.clone(), multiview: None };
            let mut text = String::new();
            glsl::Writer::new(&mut text, &module, &info, &options, &pipeline, naga::proc::BoundsCheckPolicies::default())
                .and_then(|mut writer| writer.write())
                .map_err(|error| format!("{}: {error}", entry.name))?;
            written.push(text);
        }
        Ok(written)
    }

    #[test]
    fn every_pass_has_what_it_draws_with() {
        for (name, source) in PASSES {
            let (module, _) = validated(source);
            assert!(module.entry_points.iter().any(|entry| entry.stage == ShaderStage::Vertex), "{name}");
        }
    }

    #[test]
    fn every_pass_can_be_written_for_webgl2() {
        for (name, source) in PASSES {
            let written = write_webgl2(source).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert!(written.iter().all(|text| text.starts_with("#version 300 es")), "{name}");
        }
    }

    #[test]
    fn storage_buffers_and_compute_are_refused_for_webgl2() {
        let storage =
            "@group(0) @binding(0) var<storage, read_write> data: array<u32>;\n@compute @workgroup_size(1) fn main() { data[0] = 1u; }";
        assert!(write_webgl2(storage).is_err());
    }

    #[test]
    fn passes_stay_within_sixteen_textures() {
        for (name, source) in PASSES {
            let (module, _) = validated(source);
            let num_textures =
                module.global_variables.iter().filter(|(_, v)| matches!(module.types[v.ty].inner, naga::TypeInner::Image { .. })).count();
            assert!(num_textures <= 16, "{name} has {num_textures} textures");
        }
    }
}
