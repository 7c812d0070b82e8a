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
pub(super) const RESETS: std::ops::RangeInclusive<u32> = 0x7C..=0x9C;
pub(super) const ENABLES: std::ops::RangeInclusive<u32> = 0xD4..=0xF4;

pub(super) static REGISTERS: [Register; 34] = [
    keeps(CR, "CR", 0x83, 0x150D_129B),
    keeps(CFGR, "CFGR", 0, 0xFFFC_FFC7),
    keeps(D1CFGR, "D1CFGR", 0, 0xF7F),
    keeps(D2CFGR, "D2CFGR", 0, 0x770),
    keeps(0x20, "D3CFGR", 0, 0x70),
    keeps(PLLCKSELR, "PLLCKSELR", 0x0202_0200, 0x03F3_F3F3),
    keeps(PLLCFGR, "PLLCFGR", 0x01FF_0000, 0x01FF_0FFF),
    keeps(PLL1DIVR, "PLL1DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x38, "PLL2DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x40, "PLL3DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x4C, "D1CCIPR", 0, 0x3001_0033),
    keeps(D2CCIP1R, "D2CCIP1R", 0, 0xB137_71C7),
    keeps(D2CCIP2R, "D2CCIP2R", 0, 0x70F0_333F),
    keeps(0x58, "D3CCIPR", 0, 0x77E3_FF07),
    keeps(BDCR, "BDCR", 0, 0x1_837D),
    keeps(CSR, "CSR", 0, 1),
    keeps(0x7C, "AHB3RSTR", 0, 0x8001_5031),
    keeps(0x80, "AHB1RSTR", 0, 0x0A00_8023),
    keeps(0x84, "AHB2RSTR", 0, 0x271),
    keeps(0x88, "AHB4RSTR", 0, 0x0328_07FF),
    keeps(0x8C, "APB3RSTR", 0, 0x8),
    keeps(0x90, "APB1LRSTR", 0, 0xE8FF_C3FF),
    keeps(0x94, "APB1HRSTR", 0, 0x136),
    keeps(0x98, "APB2RSTR", 0, 0x31D7_3033),
    keeps(0x9C, "APB4RSTR", 0, 0x0020_DEAA),
    keeps(RSR, "RSR", 0x00FE_0000, 1 << 16),
    keeps(0xD4, "AHB3ENR", 0, 0x0001_5031),
    keeps(0xD8, "AHB1ENR", 0, 0x1E03_8023),
    keeps(0xDC, "AHB2ENR", 0, 0xE000_0271),
    keeps(0xE0, "AHB4ENR", 0, 0x1328_07FF),
    keeps(0xE4, "APB3ENR", 0, 0x48),
    keeps(0xE8, "APB1LENR", 0, 0xE8FF_CBFF),
    keeps(0xEC, "APB1HENR", 0, 0x136),
    keeps(0xF4, "APB4ENR", 0, 0x0021_DEAA),
];
