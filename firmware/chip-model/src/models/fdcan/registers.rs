//! FDCAN1's registers, and which of them are protected. RM0433, "FDCAN registers".

use crate::device::*;

pub(super) const CCCR: u32 = 0x18;
pub(super) const NBTP: u32 = 0x1C;
pub(super) const ECR: u32 = 0x40;
pub(super) const PSR: u32 = 0x44;
pub(super) const IR: u32 = 0x50;
pub(super) const IE: u32 = 0x54;
pub(super) const ILE: u32 = 0x5C;
pub(super) const GFC: u32 = 0x80;
pub(super) const SIDFC: u32 = 0x84;
pub(super) const XIDFC: u32 = 0x88;
pub(super) const XIDAM: u32 = 0x90;
pub(super) const RXFC: [u32; 2] = [0xA0, 0xB0];
pub(super) const RXFS: [u32; 2] = [0xA4, 0xB4];
pub(super) const RXFA: [u32; 2] = [0xA8, 0xB8];
pub(super) const TXBC: u32 = 0xC0;
pub(super) const TXFQS: u32 = 0xC4;
pub(super) const TXBRP: u32 = 0xCC;
pub(super) const TXBAR: u32 = 0xD0;
pub(super) const TXBCR: u32 = 0xD4;
pub(super) const TXBTO: u32 = 0xD8;
pub(super) const TXBCF: u32 = 0xDC;
pub(super) const TXBTIE: u32 = 0xE0;
pub(super) const CCFG: u32 = 0x804;

pub(super) static REGISTERS: [Register; 37] = [
    read_only(0x00, "CREL", 0x3214_1218),
    read_only(0x04, "ENDN", 0x8765_4321),
    read_write(0x14, "RWD", 0, 0xFF),
    read_write(CCCR, "CCCR", 1, 0xF3F7),
    read_write(NBTP, "NBTP", 0x0600_0A03, 0xFFFF_FF7F),
    read_only(ECR, "ECR", 0),
    read_only(PSR, "PSR", 0x707),
    command(IR, "IR", 0x3FCF_FFFF),
    read_write(IE, "IE", 0, 0x3FCF_FFFF),
    read_write(0x58, "ILS", 0, 0x3FCF_FFFF),
    read_write(ILE, "ILE", 0, 3),
    read_write(GFC, "GFC", 0, 0x3F),
    read_write(SIDFC, "SIDFC", 0, 0xFF_FFFC),
    read_write(XIDFC, "XIDFC", 0, 0x7F_FFFC),
    read_write(XIDAM, "XIDAM", 0x1FFF_FFFF, 0x1FFF_FFFF),
    read_write(RXFC[0], "RXF0C", 0, 0xFF7F_FFFC),
    read_only(RXFS[0], "RXF0S", 0),
    command(RXFA[0], "RXF0A", 0x3F),
    read_write(RXFC[1], "RXF1C", 0, 0xFF7F_FFFC),
    read_only(RXFS[1], "RXF1S", 0),
    command(RXFA[1], "RXF1A", 0x3F),
    read_write(0xAC, "RXBC", 0, 0xFFFC),
    read_write(0xBC, "RXESC", 0, 0x777),
    read_write(TXBC, "TXBC", 0, 0x7F3F_FFFC),
    read_only(TXFQS, "TXFQS", 0),
    read_write(0xC8, "TXESC", 0, 7),
    read_only(TXBRP, "TXBRP", 0),
    command(TXBAR, "TXBAR", !0),
    command(TXBCR, "TXBCR", !0),
    read_only(TXBTO, "TXBTO", 0),
    read_only(TXBCF, "TXBCF", 0),
    read_write(TXBTIE, "TXBTIE", 0, !0),
    read_write(0xE4, "TXBCIE", 0, !0),
    read_write(0xF0, "TXEFC", 0, 0x3F3F_FFFC),
    read_only(0xF4, "TXEFS", 0),
    read_only(0x800, "CCU_CREL", 0),
    read_write(CCFG, "CCU_CCFG", 0x04, 0x80FF_FFDF),
];
/// Writable only while INIT and CCE are set.
pub(super) const PROTECTED: [u32; 14] =
    [0x14, NBTP, GFC, SIDFC, XIDFC, XIDAM, RXFC[0], RXFC[1], 0xAC, 0xBC, TXBC, 0xC8, 0xF0, CCFG];

pub(super) const INIT: u32 = 1;
pub(super) const CCE: u32 = 1 << 1;
pub(super) const RESTRICTED: u32 = 1 << 2;
// Flags of IR.
pub(super) const TC: u32 = 1 << 9;
pub(super) const TCF: u32 = 1 << 10;
pub(super) const EP: u32 = 1 << 23;
pub(super) const EW: u32 = 1 << 24;
pub(super) const BO: u32 = 1 << 25;
/// CCU_CCFG: BCC, bypass of the clock calibration unit.
pub(super) const BYPASS: u32 = 1 << 6;
/// Words of the message RAM.
pub(super) const WORDS: usize = 2560;
pub(super) const ELEMENT: usize = 4;
