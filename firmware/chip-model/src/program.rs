//! The firmware's ELF file, with its symbols and defmt's format strings.

use defmt_decoder::{DecodeError, StreamDecoder, Table};
use object::elf::{FileHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use object::{LittleEndian, Object, ObjectSection, ObjectSymbol, SymbolKind};

/// A program for the chip.
pub struct Program {
    /// The loadable segments: address and contents.
    pub segments: Vec<(u32, Vec<u8>)>,
    /// Addresses of WFE, WFI and SEV.
    pub waits: Vec<u32>,
    /// Address of SEGGER RTT's control block.
    pub rtt: Option<u32>,
    functions: Vec<(u32, u32, String)>,
    symbols: Vec<(String, u32)>,
    table: Option<Box<Table>>,
}

// Encodings of instructions.
pub(crate) const WFE: u16 = 0xBF20;
pub(crate) const WFI: u16 = 0xBF30;
pub(crate) const SEV: u16 = 0xBF40;

impl Program {
    /// Parses an ELF file.
    ///
    /// # Errors
    /// It is not an ELF file of a Cortex-M.
    pub fn read(bytes: &[u8]) -> Result<Self, String> {
        let header = FileHeader32::<LittleEndian>::parse(bytes).map_err(|error| error.to_string())?;
        let endian = header.endian().map_err(|error| error.to_string())?;
        let segments = header.program_headers(endian, bytes).map_err(|error| error.to_string())?;
        let segments = segments.iter().filter(|segment| segment.p_type(endian) == PT_LOAD);
        let segments = segments
            .map(|segment| (segment.p_paddr(endian), segment.data(endian, bytes).unwrap_or(&[]).to_vec()))
            .filter(|(_, data)| !data.is_empty())
            .collect();
        let file = object::File::parse(bytes).map_err(|error| error.to_string())?;
        let mut functions = Vec::new();
        let mut symbols = Vec::new();
        for symbol in file.symbols() {
            let Ok(name) = symbol.name() else { continue };
            let address = symbol.address() as u32;
            let name = format!("{:#}", rustc_demangle::demangle(name));
            if symbol.kind() == SymbolKind::Text {
                functions.push((address & !1, symbol.size() as u32, name.clone()));
            }
            symbols.push((name, address));
        }
        functions.sort();
        let text = file.section_by_name(".text").ok_or("no .text")?;
        let code = text.data().map_err(|error| error.to_string())?;
        let waits = code.chunks_exact(2).enumerate().filter_map(|(index, half)| {
            let is_wait = [WFE, WFI, SEV].contains(&u16::from_le_bytes([half[0], half[1]]));
            is_wait.then_some(text.address() as u32 + 2 * index as u32)
        });
        let table = Table::parse(bytes).map_err(|error| format!("its log: {error}"))?.map(Box::new);
        let rtt = symbols.iter().find(|(name, _)| name == "_SEGGER_RTT").map(|(_, address)| *address);
        Ok(Self { segments, waits: waits.collect(), rtt, functions, symbols, table })
    }

    /// Adds the symbols of other programs, which are put into flash in another way: the firmware that this loader runs.
    /// All of them must have their log at the same address and use the same table of format strings.
    #[must_use]
    pub fn knowing(mut self, others: Vec<Self>) -> Self {
        for mut other in others {
            self.waits.append(&mut other.waits);
            self.functions.append(&mut other.functions);
            self.symbols.append(&mut other.symbols);
            self.rtt = self.rtt.or(other.rtt);
            self.table = self.table.or(other.table);
        }
        self.functions.sort();
        self
    }

    /// Address, function and offset, for messages.
    pub fn place(&self, address: u32) -> String {
        let behind = self.functions.partition_point(|(start, ..)| *start <= address);
        match behind.checked_sub(1).map(|index| &self.functions[index]) {
            Some((start, size, name)) if address < start + size.max(&2) => {
                format!("{address:08X}, {name}+{:#x}", address - start)
            }
            _ => format!("{address:08X}"),
        }
    }

    /// The first function whose name contains all these parts.
    pub fn function(&self, parts: &[&str]) -> Option<u32> {
        let has_all = |name: &str| parts.iter().all(|part| name.contains(part));
        self.functions.iter().find(|(.., name)| has_all(name)).map(|(start, ..)| *start)
    }

    /// The address of a symbol, by its full name.
    pub fn symbol(&self, name: &str) -> Option<u32> {
        self.symbols.iter().find(|(symbol, _)| symbol == name).map(|(_, address)| *address)
    }

    /// A new decoder for the log; `None` if the program has no defmt log.
    pub fn log_reader(&self) -> Option<Box<dyn StreamDecoder + Send + Sync + '_>> {
        self.table.as_ref().map(|table| table.new_stream_decoder())
    }
}

/// Decodes the complete records, each as `level: text`.
pub(crate) fn texts(decoder: &mut (dyn StreamDecoder + Send + Sync + '_), bytes: &[u8]) -> Vec<String> {
    decoder.received(bytes);
    let mut texts = Vec::new();
    loop {
        match decoder.decode() {
            Ok(frame) => {
                let level = frame.level().map_or("print", |level| level.as_str());
                texts.push(format!("{level}: {}", frame.display_message()));
            }
            Err(DecodeError::UnexpectedEof) => return texts,
            Err(DecodeError::Malformed) => texts.push("malformed".into()),
        }
    }
}
