//! The Ethernet MAC with its DMA, on RMII. RM0433, "Ethernet: media access control with DMA controller".
//!
//! The DMA processes descriptor rings in AXI SRAM; it does not reach the DTCM. A software reset completes only
//! with the PHY's 50 MHz on the pin. Refused: a software reset before RMII is selected, MDC above 2.5 MHz,
//! packets in several descriptors, and receive buffers that are too short.

use std::collections::VecDeque;

use super::phy::Phy;
use crate::device::*;

const MACCR: u32 = 0x000;
const MACPFR: u32 = 0x008;
const MDIOAR: u32 = 0x200;
const MDIODR: u32 = 0x204;
const MACA0HR: u32 = 0x300;
const MACA0LR: u32 = 0x304;
const DMAMR: u32 = 0x1000;
const TXCR: u32 = 0x1104;
const RXCR: u32 = 0x1108;
const TXDLAR: u32 = 0x1114;
const RXDLAR: u32 = 0x111C;
const TXDTPR: u32 = 0x1120;
const TXRLR: u32 = 0x112C;
const RXRLR: u32 = 0x1130;
const IER: u32 = 0x1134;
const CSR: u32 = 0x1160;

static REGISTERS: [Register; 24] = [
    read_write(MACCR, "MACCR", 0, 0xFFFB_7F7F),
    read_write(MACPFR, "MACPFR", 0, 0x8031_07FF),
    read_write(0x070, "MACQTXFCR", 0, 0xFFFF_00F3),
    read_write(MDIOAR, "MACMDIOAR", 0, 0x0FFF_7F1F),
    read_write(MDIODR, "MACMDIODR", 0, !0),
    read_write(MACA0HR, "MACA0HR", 0x8000_FFFF, 0xFFFF),
    read_write(MACA0LR, "MACA0LR", !0, !0),
    read_write(0x70C, "MMC_RX_INTERRUPT_MASK", 0, 0x0C02_0060),
    read_write(0x710, "MMC_TX_INTERRUPT_MASK", 0, 0x0C20_C000),
    read_write(0xD00, "MTLTXQOMR", 0x7_0008, 0x7_0073),
    read_write(0xD30, "MTLRXQOMR", 0x70_0000, 0x0071_C7FB),
    read_write(DMAMR, "DMAMR", 0, 0x3_7803),
    read_write(0x1004, "DMASBMR", 0x0101_0000, 0xD001),
    read_write(TXCR, "DMACTXCR", 0, 0x3F_1011),
    read_write(RXCR, "DMACRXCR", 0, 0x803F_7FFF),
    read_write(TXDLAR, "DMACTXDLAR", 0, !3),
    read_write(RXDLAR, "DMACRXDLAR", 0, !3),
    read_write(TXDTPR, "DMACTXDTPR", 0, !3),
    read_write(0x1128, "DMACRXDTPR", 0, !3),
    read_write(TXRLR, "DMACTXRLR", 0, 0x3FF),
    read_write(RXRLR, "DMACRXRLR", 0, 0x3FF),
    read_write(IER, "DMACIER", 0, 0xFFC7),
    command(CSR, "DMACSR", 0xFFC7),
    read_only(0x114C, "DMACCARXDR", 0),
];

/// The chip's memory, for a DMA.
pub trait Memory {
    /// Reads; `false` if there is none.
    fn fetch(&self, address: u32, bytes: &mut [u8]) -> bool;
    /// Writes; `false` if there is none.
    fn store(&mut self, address: u32, bytes: &[u8]) -> bool;
}

#[cfg(feature = "emulator")]
impl Memory for crate::unicorn::Emulator {
    fn fetch(&self, address: u32, bytes: &mut [u8]) -> bool {
        self.read(address, bytes)
    }

    fn store(&mut self, address: u32, bytes: &[u8]) -> bool {
        self.write(address, bytes)
    }
}

/// The model.
#[derive(Debug)]
pub struct Ethernet {
    bank: Bank,
    /// The PHY at its pins.
    pub phy: Phy,
    /// Frames sent.
    pub sent: VecDeque<Vec<u8>>,
    /// Number of frames sent without a link.
    pub lost: u64,
    /// Number of frames dropped: for other addresses, or without a free descriptor.
    pub dropped: u64,
    /// Number of frames received.
    pub received: u64,
    arriving: VecDeque<Vec<u8>>,
    reset_until: Option<Picos>,
    mdio_until: Option<Picos>,
    /// Index of the next descriptor of each ring.
    next: [u32; 2],
    /// The frame on the wire, the address of its descriptor, and its end.
    sending: Option<(Vec<u8>, u32, Picos)>,
    tx_resumed: bool,
}

const RECEIVE: usize = 0;
const TRANSMIT: usize = 1;

impl Ethernet {
    /// The state after power-on.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            phy: Phy::new(),
            sent: VecDeque::new(),
            lost: 0,
            dropped: 0,
            received: 0,
            arriving: VecDeque::new(),
            reset_until: None,
            mdio_until: None,
            next: [0; 2],
            sending: None,
            tx_resumed: false,
        }
    }

    /// A frame arrives from the cable, given without its FCS.
    pub fn receive(&mut self, frame: &[u8]) {
        let mut frame = frame.to_vec();
        frame.resize(frame.len().max(60), 0);
        self.arriving.push_back(frame);
    }

    /// The MAC address.
    pub fn address(&self) -> [u8; 6] {
        let (low, high) = (self.bank.get(MACA0LR).to_le_bytes(), self.bank.get(MACA0HR).to_le_bytes());
        [low[0], low[1], low[2], low[3], high[0], high[1]]
    }

    fn has(&self, register: u32, bits: u32) -> bool {
        self.bank.get(register) & bits == bits
    }

    fn has_reference(&self, at: &Context<'_>) -> bool {
        self.phy.has_clock && at.is_rmii && Pin('A', 1).is(at.functions, FUNCTION)
    }

    fn raise(&mut self, flag: u32) {
        let summary = if self.bank.get(IER) & flag != 0 { 1 << 15 } else { 0 };
        self.bank.set(CSR, self.bank.get(CSR) | flag | summary);
    }

    fn passes(&self, frame: &[u8]) -> bool {
        let multicast = frame[0] & 1 != 0;
        let all = frame[..6] == [0xFF; 6];
        frame[..6] == self.address() || all || multicast && self.has(MACPFR, 1 << 4) || self.has(MACPFR, 1)
    }

    fn access_phy(&mut self, command: u32, at: &Context<'_>) -> Result<(), Refusal> {
        const DIVIDERS: [u32; 8] = [42, 62, 16, 26, 102, 124, 0, 0];
        let divider = DIVIDERS[(command >> 8 & 7) as usize];
        let clock = at.clocks.hclk.checked_div(divider).unwrap_or(0);
        if !(1..=2_500_000).contains(&clock) {
            return refuse(format!("MDC would run at {clock} Hz"));
        }
        let (phy, register) = (command >> 21 & 31, command >> 16 & 31);
        let has_pins = Pin('A', 2).is(at.functions, FUNCTION) && Pin('C', 1).is(at.functions, FUNCTION);
        let until = at.now + 64 * cycle(clock);
        match (command >> 2 & 3, has_pins) {
            (3, true) => {
                let value = self.phy.read(phy, register, until);
                self.bank.set(MDIODR, value.into());
            }
            (3, false) => self.bank.set(MDIODR, 0xFFFF),
            (1, true) => self.phy.write(phy, register, self.bank.get(MDIODR) as u16, until)?,
            (1, false) => {}
            _ => return refuse("neither a read nor a write of clause 22"),
        }
        self.mdio_until = Some(until);
        Ok(())
    }

    fn descriptor(&self, ring: usize, memory: &dyn Memory) -> Result<(u32, [u32; 4]), Refusal> {
        let list = self.bank.get([RXDLAR, TXDLAR][ring]);
        let place = list + 16 * self.next[ring];
        check_dma_range(place, 16)?;
        let mut bytes = [0; 16];
        memory.fetch(place, &mut bytes);
        let word = |index: usize| u32::from_le_bytes(bytes[4 * index..][..4].try_into().expect("four"));
        Ok((place, std::array::from_fn(word)))
    }

    fn advance_ring(&mut self, ring: usize) {
        let len = (self.bank.get([RXRLR, TXRLR][ring]) & 0x3FF) + 1;
        self.next[ring] = (self.next[ring] + 1) % len;
    }

    /// Processes the descriptor rings.
    ///
    /// # Errors
    /// A descriptor is wrong, or of a kind that is not modelled.
    pub fn transfer(&mut self, memory: &mut dyn Memory, at: &Context<'_>) -> Result<(), Refusal> {
        loop {
            if let Some((frame, place, _)) = self.sending.take_if(|(.., until)| at.now >= *until) {
                let mut word = [0; 4];
                memory.fetch(place + 12, &mut word);
                // Write back without OWN and error flags.
                memory.store(place + 12, &(u32::from_le_bytes(word) & 0x3000_0000).to_le_bytes());
                if self.phy.is_up(at.now) {
                    self.sent.push_back(frame);
                } else {
                    self.lost += 1;
                }
                self.raise(1);
                continue;
            }
            if self.sending.is_some() || !self.has(TXCR, 1) || !self.has(MACCR, 2) || !self.tx_resumed {
                break;
            }
            let (place, [buffer, _, lengths, control]) = self.descriptor(TRANSMIT, memory)?;
            if control >> 31 == 0 {
                // Suspended until the tail pointer is written.
                self.tx_resumed = false;
                self.raise(1 << 2);
                break;
            }
            if control >> 28 & 7 != 3 {
                return refuse("a packet in several descriptors, or a context, is not modelled");
            }
            let len = lengths & 0x3FFF;
            check_dma_range(buffer, len)?;
            let mut frame = vec![0; len as usize];
            memory.fetch(buffer, &mut frame);
            frame.resize(frame.len().max(60), 0);
            let wire = (frame.len() as u64 + 24) * 8 * cycle(100_000_000);
            self.sending = Some((frame, place, at.now + wire));
            self.advance_ring(TRANSMIT);
        }
        while let Some(frame) = self.arriving.pop_front() {
            let is_on = self.has(RXCR, 1) && self.has(MACCR, 1) && self.phy.is_up(at.now);
            if !is_on || !self.passes(&frame) {
                self.dropped += 1;
                continue;
            }
            let (place, [buffer, _, _, control]) = self.descriptor(RECEIVE, memory)?;
            if control >> 31 == 0 {
                self.dropped += 1;
                self.raise(1 << 7);
                continue;
            }
            let len = frame.len() as u32 + 4;
            if control >> 24 & 1 == 0 || len > self.bank.get(RXCR) >> 1 & 0x3FFF {
                return refuse("a receive descriptor without a buffer that a frame fits in");
            }
            check_dma_range(buffer, len)?;
            memory.store(buffer, &frame);
            memory.store(buffer + frame.len() as u32, &[0; 4]);
            memory.store(place + 12, &(0x3000_0000 | len).to_le_bytes());
            self.advance_ring(RECEIVE);
            self.received += 1;
            self.raise(if control >> 30 & 1 != 0 { 1 << 6 } else { 0 });
        }
        Ok(())
    }
}

/// Refuses addresses that the DMA does not reach. It also reaches other RAM, which is not used.
fn check_dma_range(address: u32, len: u32) -> Result<(), Refusal> {
    if (0x2400_0000..=0x2408_0000).contains(&address) && address + len <= 0x2408_0000 {
        return Ok(());
    }
    refuse(format!("the DMA does not reach {address:08X}"))
}

impl Default for Ethernet {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Ethernet {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        let busy = match offset {
            DMAMR => u32::from(self.reset_until.is_some()),
            MDIOAR => u32::from(self.mdio_until.is_some()),
            _ => 0,
        };
        Ok(self.bank.read(offset)? | busy)
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        self.advance(at)?;
        if self.reset_until.is_some() {
            return refuse("written during its software reset (DMAMR.SWR)");
        }
        match offset {
            DMAMR if value & 1 != 0 => {
                if !at.is_rmii {
                    return refuse("software reset before RMII is selected");
                }
                let done = if self.has_reference(at) { at.now + MICRO } else { Picos::MAX };
                self.reset_until = Some(done);
                return Ok(());
            }
            MDIOAR | MDIODR if self.mdio_until.is_some() => return refuse("MDIO is busy (MB)"),
            MDIOAR if value & 1 != 0 => {
                self.bank.write(MDIOAR, value & !1)?;
                return self.access_phy(value, at);
            }
            CSR => {
                self.bank.check(CSR, value)?;
                self.bank.set(CSR, self.bank.get(CSR) & !value);
                return Ok(());
            }
            TXDLAR | RXDLAR | TXRLR | RXRLR => {
                let ring = usize::from(matches!(offset, TXDLAR | TXRLR));
                if self.has([RXCR, TXCR][ring], 1) {
                    return refuse("the ring is changed while its DMA channel runs");
                }
                self.next[ring] = 0;
            }
            TXDTPR => self.tx_resumed = true,
            TXCR if value & 1 != 0 => self.tx_resumed = true,
            _ => {}
        }
        let strobes = if offset == 0xD00 { 1 } else { 0 };
        self.bank.check(offset, value)?;
        self.bank.set(offset, value & !strobes);
        Ok(())
    }

    fn advance(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        if self.reset_until.is_some_and(|until| at.now >= until) {
            self.bank = Bank::new(&REGISTERS);
            self.reset_until = None;
            self.next = [0; 2];
            self.sending = None;
        }
        if self.mdio_until.is_some_and(|until| at.now >= until) {
            self.mdio_until = None;
        }
        Ok(())
    }

    fn deadline(&self, at: &Context<'_>) -> Option<Picos> {
        let reset_until = self.reset_until.filter(|until| *until != Picos::MAX);
        let sent = self.sending.as_ref().map(|(.., until)| *until);
        let arrived = (!self.arriving.is_empty()).then_some(at.now);
        [sent, reset_until, self.mdio_until, arrived].into_iter().flatten().min()
    }

    fn interrupt_line(&self) -> bool {
        let asked = self.bank.get(CSR) & self.bank.get(IER);
        asked & 0x8000 != 0 && asked & 0x7FF != 0
    }

    fn reset(&mut self) {
        let (phy, sent) = (std::mem::take(&mut self.phy), std::mem::take(&mut self.sent));
        let (lost, dropped, received) = (self.lost, self.dropped, self.received);
        *self = Self { phy, sent, lost, dropped, received, ..Self::new() };
    }
}

/// Alternate function of its pins.
const FUNCTION: u8 = 11;
