//! Registers and bits of a USART. RM0433, "USART registers".

use crate::device::*;

pub(super) const CR1: u32 = 0x00;
pub(super) const CR2: u32 = 0x04;
pub(super) const CR3: u32 = 0x08;
pub(super) const BRR: u32 = 0x0C;
pub(super) const ISR: u32 = 0x1C;
pub(super) const ICR: u32 = 0x20;
pub(super) const RDR: u32 = 0x24;
pub(super) const TDR: u32 = 0x28;
pub(super) const PRESC: u32 = 0x2C;

pub(super) static REGISTERS: [Register; 10] = [
    read_write(CR1, "CR1", 0, !0),
    read_write(CR2, "CR2", 0, 0xFFFF_FF79),
    read_write(CR3, "CR3", 0, !0x0001_0000),
    read_write(BRR, "BRR", 0, 0xFFFF),
    command(0x18, "RQR", 0x1F),
    read_only(ISR, "ISR", 0),
    command(ICR, "ICR", 0x0012_3BFF),
    read_only(RDR, "RDR", 0),
    command(TDR, "TDR", 0x1FF),
    read_write(PRESC, "PRESC", 0, 0xF),
];

pub(super) const PE: u32 = 1;
pub(super) const FE: u32 = 1 << 1;
pub(super) const NE: u32 = 1 << 2;
pub(super) const ORE: u32 = 1 << 3;
pub(super) const IDLE: u32 = 1 << 4;
pub(super) const RXFNE: u32 = 1 << 5;
pub(super) const TC: u32 = 1 << 6;
pub(super) const TXFNF: u32 = 1 << 7;
pub(super) const TXFE: u32 = 1 << 23;
pub(super) const RXFT: u32 = 1 << 26;
pub(super) const TXFT: u32 = 1 << 27;

pub(super) const UE: u32 = 1;
pub(super) const RE: u32 = 1 << 2;
pub(super) const TE: u32 = 1 << 3;
pub(super) const PCE: u32 = 1 << 10;
pub(super) const OVER8: u32 = 1 << 15;
pub(super) const FIFOEN: u32 = 1 << 29;
pub(super) const ONEBIT: u32 = 1 << 11;
pub(super) const DEM: u32 = 1 << 14;
pub(super) const DEP: u32 = 1 << 15;
