//! Puts each pass together from its file and what that includes, lets naga check it, and writes what the crate exports:
//! the sources and the layouts of their uniform blocks.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Passes: each file holds the entry points of one.
const PASSES: [&str; 15] = [
    "background",
    "deltas",
    "eye",
    "hair",
    "influence",
    "masks",
    "normals",
    "plain",
    "present",
    "scatter",
    "shadow",
    "skin",
    "tone",
    "wet",
    "wireframe",
];
/// Parts that are exported by themselves, too: tests build passes of their own from them.
const PARTS: [&str; 3] = ["skinning", "surface", "wrinkles"];
/// `//!include NAME` on a line of its own puts `NAME.wgsl` there, once.
const INCLUDE: &str = "//!include ";
/// The smallest uniform block every WebGL2 device takes, bytes.
const MAX_UNIFORM_BYTES: u32 = 16 << 10;

fn main() {
    let folder = PathBuf::from("src/wgsl");
    println!("cargo::rerun-if-changed=src/wgsl");
    let mut out = String::new();
    let mut layouts = BTreeMap::new();
    for pass in PASSES {
        let source = assemble(&folder, pass);
        let module = check(pass, &source);
        collect_layouts(pass, &module, &mut layouts);
        write_source(&mut out, pass, &source);
    }
    for part in PARTS {
        write_source(&mut out, part, &assemble(&folder, part));
    }
    let names: Vec<String> = PASSES.iter().map(|pass| format!("{:?}, {}", pass, pass.to_uppercase())).collect();
    writeln!(out, "/// Every pass by its name.\npub const PASSES: [(&str, &str); {}] = [({})];", names.len(), names.join("), ("))
        .expect("strings grow");
    writeln!(out, "/// Layouts of the uniform blocks and their parts, bytes.\npub mod layout {{").expect("strings grow");
    for text in layouts.values() {
        out.push_str(text);
    }
    out.push_str("}\n");
    let path = Path::new(&std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR")).join("shaders.rs");
    std::fs::write(&path, out).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
}

fn write_source(out: &mut String, name: &str, source: &str) {
    writeln!(out, "/// `{name}.wgsl` with what it includes.\npub const {}: &str = {source:?};", name.to_uppercase()).expect("strings grow");
}

fn assemble(folder: &Path, name: &str) -> String {
    fn append(folder: &Path, name: &str, included: &mut BTreeSet<String>, out: &mut String) {
        if !included.insert(name.to_owned()) {
            return;
        }
        let path = folder.join(format!("{name}.wgsl"));
        let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        for line in text.lines() {
            match line.strip_prefix(INCLUDE) {
                Some(part) => append(folder, part.trim(), included, out),
                None => {
                    out.push_str(line);
                    out.push('\n');
                }
            }
        }
    }
    let mut out = String::new();
    append(folder, name, &mut BTreeSet::new(), &mut out);
    out
}

fn check(pass: &str, source: &str) -> naga::Module {
    let module = naga::front::wgsl::parse_str(source).unwrap_or_else(|error| panic!("{pass}.wgsl: {}", error.emit_to_string(source)));
    naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
        .validate(&module)
        .unwrap_or_else(|error| panic!("{pass}.wgsl: {}", error.emit_to_string(source)));
    module
}

/// One Rust module for each struct in the uniform address space: `SIZE` and the offset of each member.
fn collect_layouts(pass: &str, module: &naga::Module, layouts: &mut BTreeMap<String, String>) {
    let mut wanted: Vec<naga::Handle<naga::Type>> = module
        .global_variables
        .iter()
        .filter(|(_, variable)| variable.space == naga::AddressSpace::Uniform)
        .map(|(_, variable)| variable.ty)
        .collect();
    while let Some(handle) = wanted.pop() {
        let ty = &module.types[handle];
        match &ty.inner {
            naga::TypeInner::Struct { members, span } => {
                if *span > MAX_UNIFORM_BYTES {
                    panic!("{pass}.wgsl: {:?} takes {span} bytes, a WebGL2 uniform block holds {MAX_UNIFORM_BYTES}", ty.name);
                }
                let name = ty.name.clone().unwrap_or_else(|| panic!("{pass}.wgsl: a uniform struct has no name"));
                let mut text = format!(
                    "    /// `{name}`.\n    pub mod {} {{\n        /// Bytes.\n        pub const SIZE: usize = {span};\n",
                    snake(&name)
                );
                for member in members {
                    let member_name = member.name.as_deref().unwrap_or_default();
                    writeln!(
                        text,
                        "        /// Offset of `{member_name}`.\n        pub const {}: usize = {};",
                        member_name.to_uppercase(),
                        member.offset
                    )
                    .expect("strings grow");
                    wanted.push(member.ty);
                }
                text.push_str("    }\n");
                if let Some(known) = layouts.insert(name.clone(), text.clone())
                    && known != text
                {
                    panic!("{pass}.wgsl: struct {name} differs from the one of another pass");
                }
            }
            naga::TypeInner::Array { base, .. } => wanted.push(*base),
            _ => {}
        }
    }
}

fn snake(name: &str) -> String {
    let mut out = String::new();
    for (i, letter) in name.char_indices() {
        if letter.is_uppercase() && i > 0 {
            out.push('_');
        }
        out.extend(letter.to_lowercase());
    }
    out
}
