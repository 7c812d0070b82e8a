//! RCC's registers. RM0433, "RCC registers".

use crate::device::*;

pub(super) const CR: u32 = 0x00;
pub(super) const CFGR: u32 = 0x10;
pub(super) const D1CFGR: u32 = 0x18;
pub(super) const D2CFGR: u32 = 0x1C;
pub(super) const PLLCKSELR: u32 = 0x28;
pub(super) const PLLCFGR: u32 = 0x2C;
pub(super) const PLL1DIVR: u32 = 0x30;
pub(super) const D2CCIP1R: u32 = 0x50;
pub(super) const D2CCIP2R: u32 = 0x54;
pub(super) const BDCR: u32 = 0x70;
pub(super) const CSR: u32 = 0x74;
pub(super) const RSR: u32 = 0xD0;
pub(super) const ENABLES: std::ops::RangeInclusive<u32> = 0xD4..=0xF4;

pub(super) static REGISTERS: [Register; 34] = [
    read_write(CR, "CR", 0x83, 0x150D_129B),
    read_write(CFGR, "CFGR", 0, 0xFFFC_FFC7),
    read_write(D1CFGR, "D1CFGR", 0, 0xF7F),
    read_write(D2CFGR, "D2CFGR", 0, 0x770),
    read_write(0x20, "D3CFGR", 0, 0x70),
    read_write(PLLCKSELR, "PLLCKSELR", 0x0202_0200, 0x03F3_F3F3),
    read_write(PLLCFGR, "PLLCFGR", 0x01FF_0000, 0x01FF_0FFF),
    read_write(PLL1DIVR, "PLL1DIVR", 0x0101_0280, 0x7F7F_FFFF),
    read_write(0x38, "PLL2DIVR", 0x0101_0280, 0x7F7F_FFFF),
    read_write(0x40, "PLL3DIVR", 0x0101_0280, 0x7F7F_FFFF),
    read_write(0x4C, "D1CCIPR", 0, 0x3001_0033),
    read_write(D2CCIP1R, "D2CCIP1R", 0, 0xB137_71C7),
    read_write(D2CCIP2R, "D2CCIP2R", 0, 0x70F0_333F),
    read_write(0x58, "D3CCIPR", 0, 0x77E3_FF07),
    read_write(BDCR, "BDCR", 0, 0x1_837D),
    read_write(CSR, "CSR", 0, 1),
    read_write(0x7C, "AHB3RSTR", 0, 0x8001_5031),
    read_write(0x80, "AHB1RSTR", 0, 0x0A00_8023),
    read_write(0x84, "AHB2RSTR", 0, 0x271),
    read_write(0x88, "AHB4RSTR", 0, 0x0328_07FF),
    read_write(0x8C, "APB3RSTR", 0, 0x8),
    read_write(0x90, "APB1LRSTR", 0, 0xE8FF_C3FF),
    read_write(0x94, "APB1HRSTR", 0, 0x136),
    read_write(0x98, "APB2RSTR", 0, 0x31D7_3033),
    read_write(0x9C, "APB4RSTR", 0, 0x0020_DEAA),
    read_write(RSR, "RSR", 0x00FE_0000, 1 << 16),
    read_write(0xD4, "AHB3ENR", 0, 0x0001_5031),
    read_write(0xD8, "AHB1ENR", 0, 0x1E03_8023),
    read_write(0xDC, "AHB2ENR", 0, 0xE000_0271),
    read_write(0xE0, "AHB4ENR", 0, 0x1328_07FF),
    read_write(0xE4, "APB3ENR", 0, 0x48),
    read_write(0xE8, "APB1LENR", 0, 0xE8FF_CBFF),
    read_write(0xEC, "APB1HENR", 0, 0x136),
    read_write(0xF4, "APB4ENR", 0, 0x0021_DEAA),
];
