//! Mistakes of a C program that are refused: null pointers, memory that is too small or misaligned, another
//! version of the header, invalid images. The calls are those of the header.

use std::ffi::{CStr, c_void};
use std::ptr::{null, null_mut};

use rgw::*;

/// Memory as a C program has it.
#[repr(C, align(16))]
struct Memory<const SIZE: usize>([u8; SIZE]);

impl<const SIZE: usize> Memory<SIZE> {
    fn new() -> Box<Self> {
        Box::new(Self([0xA5; SIZE]))
    }

    fn start(&mut self) -> *mut c_void {
        self.0.as_mut_ptr().cast()
    }
}

fn init(memory: *mut c_void, len: usize) -> (Status, *mut Gateway) {
    let mut gateway = null_mut();
    // SAFETY: all callers have memory of that length, or pass null.
    let status = unsafe { rgw_gateway_init(RGW_ABI_VERSION, memory, len, &mut gateway) };
    (status, gateway)
}

#[test]
fn unusable_memory_is_refused() {
    let mut memory = Memory::<{ RGW_GATEWAY_SIZE + RGW_ALIGN }>::new();
    let size = rgw_gateway_size();
    assert!(size <= RGW_GATEWAY_SIZE, "{size} bytes");
    assert!(RGW_GATEWAY_SIZE - size < 4096, "the header asks for far more than {size} bytes");
    let start = memory.start();
    assert_eq!(init(null_mut(), size).0, Status::Null);
    assert_eq!(init(start, size - 1).0, Status::TooSmall);
    assert_eq!(init(start.wrapping_byte_add(8), size).0, Status::Misaligned);
    assert!(memory.0.iter().all(|&byte| byte == 0xA5), "nothing was written");
    let start = memory.start();
    // SAFETY: there is room; one pointer for the result is null.
    unsafe {
        assert_eq!(rgw_gateway_init(RGW_ABI_VERSION, start, size, null_mut()), Status::Null);
        let mut gateway = null_mut();
        assert_eq!(rgw_gateway_init(RGW_ABI_VERSION + 1, start, size, &mut gateway), Status::AbiVersion);
        assert!(gateway.is_null());
    }
    let (status, gateway) = init(start, size);
    assert_eq!((status, gateway.cast::<c_void>()), (Status::Ok, start));
    assert!(memory.0[size..].iter().all(|&byte| byte == 0xA5), "nothing is written after it");
}

#[test]
fn an_invalid_image_is_refused() {
    let mut memory = Memory::<RGW_CONFIG_SIZE>::new();
    let start = memory.start();
    assert!(rgw_config_size() <= RGW_CONFIG_SIZE);
    let mut config = null_mut();
    let mut read = |image: &[u8]| {
        // SAFETY: there is room, and there are these bytes.
        unsafe { rgw_config_read(start, RGW_CONFIG_SIZE, image.as_ptr(), image.len(), &mut config) }
    };
    let newer = *b"RGCI\xE7\x03\0\0\0\0\0\0\0\0\0\0";
    let older = *b"RGCI\x01\0\0\0\0\0\0\0\0\0\0\0";
    let damaged = *b"RGCI\x04\0\0\0\0\0\0\0\0\0\0\0";
    assert_eq!(read(&[]), Status::ImageCut);
    assert_eq!(read(&[0xFF; 64]), Status::ImageNone);
    assert_eq!(read(&newer), Status::ImageVersion);
    assert_eq!(read(&older), Status::ImageVersion);
    assert_eq!(read(&damaged), Status::ImageDamaged);
    assert!(config.is_null());
    let mut version = 0;
    // SAFETY: there are these bytes, and room for the version; null is refused.
    unsafe {
        assert_eq!(rgw_image_version(newer.as_ptr(), newer.len(), &mut version), Status::Ok);
        assert_eq!(version, 999);
        assert_eq!(rgw_image_version(older.as_ptr(), older.len(), &mut version), Status::Ok);
        assert_eq!(version, 1);
        assert_eq!(rgw_image_version(null(), 16, &mut version), Status::Null);
        assert_eq!(rgw_image_version(newer.as_ptr(), newer.len(), null_mut()), Status::Null);
        assert_eq!(rgw_config_read(start, 16, newer.as_ptr(), 16, &mut config), Status::TooSmall);
        assert_eq!(rgw_config_read(start, RGW_CONFIG_SIZE, null(), 16, &mut config), Status::Null);
        assert_eq!(rgw_config_ports(null()), 0);
    }
}

#[test]
fn a_gateway_without_a_configuration_sleeps_for_ever() {
    let mut memory = Memory::<RGW_GATEWAY_SIZE>::new();
    let (_, gateway) = init(memory.start(), RGW_GATEWAY_SIZE);
    let mut buffer = [0; RGW_OUTPUT_BUFFER];
    let mut task = std::mem::MaybeUninit::<Task>::uninit();
    let (out, len) = (buffer.as_mut_ptr(), buffer.len());
    let task = task.as_mut_ptr();
    let frame = CanFrame { id: 0x800, extended: 0, remote: 0, len: 8, data: [0; 8] };
    // SAFETY: the gateway is one, the buffer has its length, and there is room for the task; null is refused.
    unsafe {
        assert_eq!(rgw_poll_output(null_mut(), 0, out, len, task), Status::Null);
        assert_eq!(rgw_poll_output(gateway, 0, null_mut(), len, task), Status::Null);
        assert_eq!(rgw_poll_output(gateway, 0, out, len - 1, task), Status::TooSmall);
        assert_eq!(rgw_poll_output(gateway, 0, out, len, null_mut()), Status::Null);
        assert_eq!(rgw_poll_output(gateway, 0, out, len, task), Status::Ok);
        assert_eq!(((*task).kind, (*task).until_us), (OutputKind::Sleep, RGW_NEVER));
        assert_eq!(rgw_gateway_configure(gateway, null()), Status::Null);
        assert_eq!(rgw_tick(null_mut(), 0), Status::Null);
        assert_eq!(rgw_port_bytes(gateway, 0, 0, null(), 1), Status::Null);
        assert_eq!(rgw_port_bytes(gateway, 0, 0, null(), 0), Status::Ok);
        assert_eq!(rgw_port_bytes(gateway, 0, 0, out, usize::MAX), Status::Invalid);
        assert_eq!(rgw_port_bus(gateway, 0, 0, 4), Status::Invalid);
        assert_eq!(rgw_port_can(gateway, 0, 0, null()), Status::Null);
        assert_eq!(
            rgw_port_can(gateway, 0, 0, &frame),
            Status::Invalid,
            "an id of 12 bits is not a standard id"
        );
        assert_eq!(rgw_port_can(gateway, 0, 0, &CanFrame { id: 1, len: 9, ..frame }), Status::Invalid);
        assert_eq!(rgw_port_can(gateway, 0, 0, &CanFrame { id: 1, ..frame }), Status::Ok);
        assert_eq!(rgw_port_info(gateway, 0, null_mut()), Status::NotThere);
        assert_eq!(rgw_link_info(gateway, 0, null_mut()), Status::NotThere);
        assert!(!rgw_is_frame(gateway, 3, null(), 8));
    }
}

#[test]
fn every_status_has_a_text_of_its_own() {
    let text = |status: u32| {
        // SAFETY: it is a static text.
        unsafe { CStr::from_ptr(rgw_status_text(status)) }.to_str().unwrap()
    };
    let header = include_str!("../include/rgw.h");
    let known = header.split("enum rgw_status").nth(1).unwrap().split("};").next().unwrap();
    let codes =
        known.lines().filter_map(|line| line.trim().strip_suffix(',')?.split(" = ").nth(1)?.parse().ok());
    let texts: std::collections::BTreeSet<&str> = codes.map(text).collect();
    assert_eq!(texts.len(), 18);
    assert!(!texts.contains(text(u32::MAX)), "unknown codes look like known ones: {texts:?}");
}
