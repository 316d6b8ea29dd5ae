//! Limits that both ends keep. Each has its reason.

/// Most bones a character may evaluate: bones and coefficients must fit WebGL2's guaranteed 16 KiB uniform block.
pub const MAX_BONES: usize = 64;
/// Most joints in a character's skin: 3 × vec4 each in the same 16 KiB uniform block, with room for the rest.
pub const MAX_JOINTS: usize = 128;
/// Most reference poses: two vec4 varyings carry their influences to the fragment stage.
pub const MAX_POSES: usize = 8;
/// Most wrinkle zones: two RGBA masks.
pub const MAX_ZONES: usize = 8;
/// Most expressions in a character's table: the six of the paper and as many again, and some.
pub const MAX_EXPRESSIONS: usize = 16;
/// Largest side of a zone mask, texels: masks are smooth (the paper's have 64), and they are decoded where a character is
/// checked.
pub const MAX_MASK_SIDE: u32 = 256;
/// Largest side of the zones' wrinkle maps, texels; the paper's have 256.
pub const MAX_ZONE_MAP_SIDE: u32 = 1024;
/// Largest side of the maps of blood, texels: they are smooth (those of Jimenez and others 2010 have 64), and all of them are
/// mixed on the processor where the face changes.
pub const MAX_COLOUR_SIDE: u32 = 128;
/// Most feature points in a user's own layout; more than any tracker in use gives (MediaPipe: 478).
pub const MAX_FEATURE_POINTS: usize = 512;
/// Most vertices of a character: WebGL2 draws of this size still hold 60 Hz on a phone.
pub const MAX_VERTICES: usize = 400_000;
/// Largest character file, bytes; the browser downloads it before the first picture.
pub const MAX_CHARACTER_BYTES: usize = 64 << 20;
/// Largest side of a character's textures, texels: what WebGL2 guarantees is 2,048, what everything in use has is 4,096.
pub const MAX_TEXTURE_SIDE: u32 = 4096;
/// Most vertex indices of a character: an unbroken surface has two triangles a vertex. Parts may share one list of them, so
/// that the size of the file alone does not bound the sum.
pub const MAX_INDICES: usize = 6 * MAX_VERTICES;
/// Largest JSON chunk of a character file, bytes: seven times that of the built-in one. Parsed it takes up to two hundred
/// times as much memory.
pub const MAX_CHARACTER_JSON_BYTES: usize = 1 << 20;
/// Most images in a character file: four for each of a dozen parts, and the wrinkle maps.
pub const MAX_IMAGES: usize = 64;
/// Most texels of a character's textures together, each use counted: four of the largest; 350 MB on the GPU with their mips.
pub const MAX_TEXELS: u64 = 4 * (MAX_TEXTURE_SIDE as u64) * (MAX_TEXTURE_SIDE as u64);
/// Largest message on a publish socket, bytes: 478 points with z and confidence as JSON take 35 KB.
pub const MAX_MESSAGE_BYTES: usize = 256 << 10;
/// Longest key of a session, bytes; the server's have 32.
pub const MAX_RESUME_KEY: usize = 64;
/// Largest time on a sender's clock, seconds: the Unix clock stays below it for two centuries, and microseconds of it
/// are whole numbers in an `f64`.
pub const MAX_SECONDS: f64 = 9e9;
/// Focal lengths from the widest lens to the longest, in widths of the picture: 157 degrees to 1 degree across.
pub const FOCAL_RANGE: [f32; 2] = [0.1, 50.0];
/// How far an evaluated point may travel from rest, metres: the range of a packet's 12-bit positions (25 µm a step).
pub const MAX_BONE_TRAVEL: f32 = 0.0511875;
/// How far the head may travel from its neutral place, metres.
pub const MAX_HEAD_TRAVEL: f32 = 0.3;
/// Reference poses that move a bone by less than this, metres, but not by nothing, are refused: noise, not a pose.
pub const MIN_POSE_TRAVEL: f32 = 0.0002;
