//! Checks accessors before the gltf crate reads them: it looks neither where they end nor what they are made of.

use super::super::checked::CharacterError;
use super::Result;
use gltf::Semantic;
use gltf::accessor::{DataType, Dimensions};

/// What an accessor must be made of to be read as what it is used for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    dimensions: Dimensions,
    types: &'static [DataType],
}

const FLOAT: &[DataType] = &[DataType::F32];
const VECTOR: Layout = Layout { dimensions: Dimensions::Vec3, types: FLOAT };

impl Layout {
    /// Positions, normals, and what a morph target adds to them and to tangents.
    pub(super) const VECTOR: Self = VECTOR;
    /// Indices of a primitive.
    pub(super) const INDEX: Self = Self { dimensions: Dimensions::Scalar, types: &[DataType::U8, DataType::U16, DataType::U32] };
    /// Inverse bind matrices.
    pub(super) const MATRIX: Self = Self { dimensions: Dimensions::Mat4, types: FLOAT };

    /// That of a vertex attribute; none where nobody reads it.
    pub(super) fn of(semantic: &Semantic) -> Option<Self> {
        const UNIT: &[DataType] = &[DataType::F32, DataType::U8, DataType::U16];
        Some(match semantic {
            Semantic::Positions | Semantic::Normals => VECTOR,
            Semantic::Tangents => Self { dimensions: Dimensions::Vec4, types: FLOAT },
            Semantic::TexCoords(0) => Self { dimensions: Dimensions::Vec2, types: UNIT },
            Semantic::Joints(0) => Self { dimensions: Dimensions::Vec4, types: &[DataType::U8, DataType::U16] },
            Semantic::Weights(0) => Self { dimensions: Dimensions::Vec4, types: UNIT },
            _ => return None,
        })
    }
}

/// Refuses an accessor that is not made of `layout`, has no element or more than `most`, or does not lie in `blob`.
pub(super) fn check(accessor: &gltf::Accessor<'_>, layout: Layout, most: usize, blob: &[u8], field: &str) -> Result<()> {
    let (dimensions, data_type) = (accessor.dimensions(), accessor.data_type());
    if dimensions != layout.dimensions || !layout.types.contains(&data_type) {
        return Err(CharacterError::field(
            field,
            format!("is {dimensions:?} of {data_type:?}, expected {:?} of {}", layout.dimensions, one_of(layout.types)),
        ));
    }
    let count = accessor.count();
    if count == 0 || count > most {
        return Err(CharacterError::field(field, format!("has {count} elements, expected 1 to {most}")));
    }
    if let Some(view) = accessor.view() {
        check_span(&view, accessor.offset(), count, accessor.size(), blob, field)?;
    }
    if let Some(sparse) = accessor.sparse() {
        if sparse.count() == 0 || sparse.count() > count {
            return Err(CharacterError::field(field, format!("replaces {} elements sparsely, expected 1 to {count}", sparse.count())));
        }
        let (indices, values) = (sparse.indices(), sparse.values());
        check_span(&indices.view(), indices.offset(), sparse.count(), indices.index_type().size(), blob, field)?;
        check_span(&values.view(), values.offset(), sparse.count(), accessor.size(), blob, field)?;
    }
    Ok(())
}

/// `count` elements of `size` bytes lie in `view`, and `view` in the file.
fn check_span(view: &gltf::buffer::View<'_>, offset: usize, count: usize, size: usize, blob: &[u8], field: &str) -> Result<()> {
    if !matches!(view.buffer().source(), gltf::buffer::Source::Bin) {
        return Err(CharacterError::field(field, "refers to another file, expected it inside the .glb"));
    }
    let stride = view.stride().unwrap_or(size);
    let last_ends = count.checked_sub(1).and_then(|last| last.checked_mul(stride)?.checked_add(size)?.checked_add(offset));
    match (last_ends, view.offset().checked_add(view.length())) {
        (Some(last_ends), Some(view_ends)) if stride >= size && last_ends <= view.length() && view_ends <= blob.len() => Ok(()),
        _ => Err(CharacterError::field(field, "reaches past the end of its buffer view or of the file")),
    }
}

fn one_of(types: &[DataType]) -> String {
    types.iter().map(|data_type| format!("{data_type:?}")).collect::<Vec<_>>().join(" or ")
}
