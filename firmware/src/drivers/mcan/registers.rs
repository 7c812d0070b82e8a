//! Layout of the message RAM, registers, and their bits.

use proto_core::recipe::model::MAX_CAN_IDS;

/// Size of the part of the message RAM that the driver uses, in words.
pub const MESSAGE_RAM_WORDS: u16 = TX_FIFO + ELEMENT_WORDS * TX_ELEMENTS;
pub(super) const FILTERS: u16 = MAX_CAN_IDS as u16;
pub(super) const STANDARD_FILTERS: u16 = 0;
pub(super) const EXTENDED_FILTERS: u16 = STANDARD_FILTERS + FILTERS;
pub(super) const RX_ELEMENTS: u16 = 64;
pub(super) const RX_FIFOS: [u16; 2] =
    [EXTENDED_FILTERS + 2 * FILTERS, EXTENDED_FILTERS + 2 * FILTERS + ELEMENT_WORDS * RX_ELEMENTS];
/// Capacity of the transmit FIFO: the frames that a port sends in one cycle.
pub(super) const TX_ELEMENTS: u16 = 32;
pub(super) const TX_FIFO: u16 = RX_FIFOS[1] + ELEMENT_WORDS * RX_ELEMENTS;
/// Words of an element: two header words and 8 bytes of data.
pub(super) const ELEMENT_WORDS: u16 = 4;

const _: () = assert!(MAX_CAN_IDS <= TX_ELEMENTS as usize);

pub(super) const ENDN: u8 = 0x04;
pub(super) const CCCR: u8 = 0x18;
pub(super) const NBTP: u8 = 0x1C;
pub(super) const ECR: u8 = 0x40;
pub(super) const PSR: u8 = 0x44;
pub(super) const IR: u8 = 0x50;
pub(super) const IE: u8 = 0x54;
pub(super) const ILS: u8 = 0x58;
pub(super) const ILE: u8 = 0x5C;
pub(super) const GFC: u8 = 0x80;
pub(super) const SIDFC: u8 = 0x84;
pub(super) const XIDFC: u8 = 0x88;
pub(super) const XIDAM: u8 = 0x90;
pub(super) const RXF0C: u8 = 0xA0;
pub(super) const RXF1C: u8 = 0xB0;
pub(super) const RXESC: u8 = 0xBC;
pub(super) const TXBC: u8 = 0xC0;
pub(super) const TXFQS: u8 = 0xC4;
pub(super) const TXESC: u8 = 0xC8;
pub(super) const TXBRP: u8 = 0xCC;
pub(super) const TXBAR: u8 = 0xD0;
pub(super) const TXBTIE: u8 = 0xE0;
pub(super) const TXEFC: u8 = 0xF0;
/// Status and acknowledge of the two receive FIFOs.
pub(super) const RX_REGISTERS: [(u8, u8); 2] = [(0xA4, 0xA8), (0xB4, 0xB8)];

pub(super) const CCCR_INIT: u32 = 1;
pub(super) const CCCR_CONFIGURE: u32 = 1 << 1;
pub(super) const CCCR_RESTRICTED: u32 = 1 << 2;
/// The bits of CCCR to preserve: all but the three above, clock stop and test mode.
pub(super) const CCCR_KEPT: u32 = 0xF340;
pub(super) const PSR_PASSIVE: u32 = 1 << 5;
pub(super) const PSR_WARNING: u32 = 1 << 6;
pub(super) const PSR_BUS_OFF: u32 = 1 << 7;
pub(super) const TXFQS_FULL: u32 = 1 << 21;
/// A frame was lost, in FIFO 0 or 1.
pub(super) const LOST: u32 = 1 << 3 | 1 << 7;
/// New frame, transmission completed, message RAM access failure, changes of the error state.
pub(super) const INTERRUPTS: u32 = 1 | 1 << 4 | 1 << 9 | 1 << 17 | 1 << 23 | 1 << 24 | 1 << 25;
/// Reject frames that match no filter, with standard and extended ids.
pub(super) const GFC_REJECT_OTHERS: u32 = 2 << 2 | 2 << 4;
/// Dual-id filter, for standard and extended ids.
pub(super) const TWO_IDS: u32 = 1 << 30;
pub(super) const TO_FIFO_0: u32 = 1;
pub(super) const TO_FIFO_1: u32 = 2;
pub(super) const HEAD_REMOTE: u32 = 1 << 29;
pub(super) const HEAD_EXTENDED: u32 = 1 << 30;
pub(super) const CONTROL_FD: u32 = 1 << 21;
