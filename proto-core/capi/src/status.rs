//! The status that every call returns, and the version of the interface.

use core::ffi::{CStr, c_char};

use proto_core::config::image::ImageError;
use proto_core::engine::BuildError;

/// Version of this interface: one more for every change of a function, a type or a number in it.
/// `rgw_gateway_init` refuses a program that was compiled with another version of the header.
pub const RGW_ABI_VERSION: u32 = 2;

/// Status of a call. Zero is success. After any other status nothing has changed, unless the function says
/// otherwise.
#[repr(u32)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Done.
    Ok = 0,
    /// A pointer is null.
    Null = 1,
    /// Memory or a buffer is too small.
    TooSmall = 2,
    /// Memory is not aligned to `RGW_ALIGN`.
    Misaligned = 3,
    /// The program was compiled with another version of the header.
    AbiVersion = 4,
    /// There is no such port, link or index.
    NotThere = 5,
    /// Not a valid code or CAN frame.
    Invalid = 6,
    /// The image is cut short.
    ImageCut = 16,
    /// It is not a configuration image.
    ImageNone = 17,
    /// The image has a version that this library does not read; `rgw_image_version` says which.
    ImageVersion = 18,
    /// The image announces more bytes than an image can have.
    ImageTooLong = 19,
    /// The image is damaged.
    ImageDamaged = 20,
    /// The image does not contain a configuration.
    ImageContents = 21,
    /// The configuration in the image is invalid; `host-sim check` says why.
    ConfigWrong = 22,
    /// A variable of the configuration has no way to or from the controller.
    ConfigPlan = 23,
    /// The configuration is larger than this library was built for.
    ConfigTooLarge = 24,
    /// The configuration names a dialect that this library does not know.
    ConfigDialect = 25,
    /// The image or the configuration is refused for another reason.
    Other = 31,
}

impl From<ImageError> for Status {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::TooShort { .. } => Self::ImageCut,
            ImageError::NotAnImage { .. } => Self::ImageNone,
            ImageError::Version { .. } => Self::ImageVersion,
            ImageError::TooLong { .. } => Self::ImageTooLong,
            ImageError::Crc { .. } => Self::ImageDamaged,
            ImageError::Contents => Self::ImageContents,
            ImageError::Config(_) => Self::ConfigWrong,
            ImageError::TooMany { .. } => Self::ConfigTooLarge,
            _ => Self::Other,
        }
    }
}

impl From<BuildError> for Status {
    fn from(error: BuildError) -> Self {
        match error {
            BuildError::Config(_) | BuildError::Part { .. } => Self::ConfigWrong,
            BuildError::Plan(_) => Self::ConfigPlan,
            BuildError::UnknownDialect => Self::ConfigDialect,
            BuildError::TooMany { .. } => Self::ConfigTooLarge,
            _ => Self::Other,
        }
    }
}

impl From<Result<(), Status>> for Status {
    fn from(result: Result<(), Status>) -> Self {
        match result {
            Ok(()) => Self::Ok,
            Err(status) => status,
        }
    }
}

/// The library's version of this interface; a program compares it with `RGW_ABI_VERSION`.
#[unsafe(no_mangle)]
pub extern "C" fn rgw_abi_version() -> u32 {
    RGW_ABI_VERSION
}

/// A status in English words: a static text that ends with a zero byte. Takes any number.
#[unsafe(no_mangle)]
pub extern "C" fn rgw_status_text(status: u32) -> *const c_char {
    #[allow(clippy::indexing_slicing, reason = "only to see that the proof can fail")]
    if crate::no_panic::PROVOKED {
        return TEXTS[status as usize].1.as_ptr();
    }
    let known = TEXTS.iter().find(|(known, _)| *known as u32 == status);
    known.map_or(c"unknown status", |(_, text)| *text).as_ptr()
}

static TEXTS: [(Status, &CStr); 18] = [
    (Status::Ok, c"done"),
    (Status::Null, c"a pointer is null"),
    (Status::TooSmall, c"memory or a buffer is too small"),
    (Status::Misaligned, c"memory is not aligned"),
    (Status::AbiVersion, c"header and library are of different versions"),
    (Status::NotThere, c"no such port, link or index"),
    (Status::Invalid, c"not a valid code or CAN frame"),
    (Status::ImageCut, c"the image is cut short"),
    (Status::ImageNone, c"not a configuration image"),
    (Status::ImageVersion, c"the image has a version that this library does not know"),
    (Status::ImageTooLong, c"the image announces more bytes than an image can have"),
    (Status::ImageDamaged, c"the image is damaged"),
    (Status::ImageContents, c"the image does not contain a configuration"),
    (Status::ConfigWrong, c"the configuration is invalid"),
    (Status::ConfigPlan, c"a variable has no way to or from the controller"),
    (Status::ConfigTooLarge, c"the configuration is larger than the library was built for"),
    (Status::ConfigDialect, c"the dialect is not known to this library"),
    (Status::Other, c"the image or the configuration was refused"),
];
