//! Update files: making them from two linked programs and a key, and showing them (docs/update.md sections 2 and 3).

use std::path::{Path, PathBuf};

use object::LittleEndian;
use object::elf::{FileHeader32, PT_LOAD};
use object::read::elf::{FileHeader, ProgramHeader};
use proto_core::config::image;
use recipe_api::key::Hex;
use recipe_update::{
    BoardName, Formats, HEADER, Header, IMAGE_OFFSET, ImageFacts, Layout, PublicKey, Slot, SlotImage,
    UpdateFile, Version, file_head, link_padding,
};
use serde_json::json;

use crate::answer::Answer;
use crate::failure::Failure;
use crate::signing_key;
use crate::table::{Look, TableCell, TableView, TextTable, facts};

/// The input for an update file.
#[derive(Debug, Clone)]
pub struct Firmware {
    /// The file with the private key.
    pub key: PathBuf,
    /// The board's name.
    pub board: String,
    /// The firmware's version.
    pub version: String,
    /// The program linked for slot A.
    pub slot_a: PathBuf,
    /// The program linked for slot B.
    pub slot_b: PathBuf,
    /// Oldest and newest version of the configuration image that the firmware reads; by default those of this program.
    pub reads: Option<(u32, u32)>,
    /// The version that the firmware writes.
    pub writes: Option<u32>,
}

/// Makes the update file.
///
/// # Errors
/// A file or an argument is wrong.
pub fn sign(firmware: &Firmware) -> Result<Vec<u8>, Failure> {
    let layout = Layout::of(&firmware.board).ok_or_else(|| {
        let names: Vec<&str> = recipe_update::BOARDS.iter().map(|layout| layout.board).collect();
        Failure::wrong(format!("no board {:?} has slots; there are {}", firmware.board, names.join(", ")))
    })?;
    let version = Version::parse(&firmware.version).ok_or_else(|| {
        Failure::wrong(format!("{:?} is no version; three numbers such as 0.3.0 are one", firmware.version))
    })?;
    let (oldest, newest) = firmware.reads.unwrap_or((image::OLDEST_VERSION, image::VERSION));
    let written = firmware.writes.unwrap_or(newest);
    let formats = Formats::new(oldest, newest, written).ok_or_else(|| {
        Failure::wrong(format!(
            "a firmware that reads configurations of the versions {oldest} to {newest} cannot write {written}"
        ))
    })?;
    let board = BoardName::parse(layout.board).ok_or_else(|| Failure::wrong("the board has no name"))?;
    let seed = signing_key::read(&firmware.key)?;
    let mut links = Vec::new();
    for (slot, path) in [(Slot::A, &firmware.slot_a), (Slot::B, &firmware.slot_b)] {
        let bytes =
            std::fs::read(path).map_err(|error| Failure::wrong(format!("{}: {error}", path.display())))?;
        let image = image_of(&bytes, layout, slot)
            .map_err(|why| Failure::wrong(format!("{}: {why}", path.display())))?;
        let parts = ImageFacts { board, slot, version, formats, store: recipe_store::VERSION };
        let header = Header::sign(parts, &image, &seed.0)
            .ok_or_else(|| Failure::wrong(format!("{}: it is empty", path.display())))?;
        links.extend(header.encode());
        links.extend(&image);
        links.resize(links.len() + link_padding(image.len()), 0xFF);
    }
    let length = (recipe_update::FILE_HEAD + links.len()) as u32;
    let mut file = file_head(Slot::ALL.len() as u32, length).to_vec();
    file.extend(links);
    Ok(file)
}

/// The image of a program for a slot: its segments as they are in flash.
fn image_of(elf: &[u8], layout: &Layout, slot: Slot) -> Result<Vec<u8>, String> {
    let header = FileHeader32::<LittleEndian>::parse(elf).map_err(|error| error.to_string())?;
    let endian = header.endian().map_err(|error| error.to_string())?;
    let segments = header.program_headers(endian, elf).map_err(|error| error.to_string())?;
    let start = layout.slot(slot) + IMAGE_OFFSET;
    let end = layout.slot(slot) + layout.slot_size();
    let mut image = Vec::new();
    for segment in segments.iter().filter(|segment| segment.p_type(endian) == PT_LOAD) {
        let data = segment.data(endian, elf).map_err(|()| "a segment is not in the file".to_owned())?;
        let address = segment.p_paddr(endian);
        if data.is_empty() {
            continue;
        }
        let behind = u64::from(address) + data.len() as u64;
        if address < start || behind > u64::from(end) {
            return Err(format!(
                "bytes {address:08X} to {behind:08X} are not within {start:08X} to {end:08X}: it is not linked for slot {slot:?}"
            ));
        }
        let at = (address - start) as usize;
        if image.len() < at + data.len() {
            image.resize(at + data.len(), 0xFF);
        }
        image[at..at + data.len()].copy_from_slice(data);
    }
    let word = |at: usize| {
        image.get(at..at + 4).map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]]))
    };
    let (Some(stack), Some(reset)) = (word(0), word(4)) else {
        return Err(format!("nothing of it is at {start:08X}, where the vector table has to be"));
    };
    let is_stack = layout.ram.iter().any(|(from, to)| (from + 1..=*to).contains(&stack)) && stack % 8 == 0;
    let is_code = (start..start + image.len() as u32).contains(&reset) && reset % 2 == 1;
    if !is_stack || !is_code {
        return Err(format!(
            "no vector table is at {start:08X}: a stack at {stack:08X} and a start at {reset:08X} are none of this board"
        ));
    }
    Ok(image)
}

/// A parsed update file.
#[derive(Debug, Clone)]
pub struct Update {
    bytes: Vec<u8>,
}

impl Update {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let bytes =
            std::fs::read(path).map_err(|error| Failure::wrong(format!("{}: {error}", path.display())))?;
        UpdateFile::parse(&bytes).map_err(|why| Failure::wrong(format!("{}: {why}", path.display())))?;
        Ok(Self { bytes })
    }

    /// Parses the bytes that [`sign`] has made.
    pub fn of(bytes: Vec<u8>) -> Result<Self, Failure> {
        UpdateFile::parse(&bytes).map_err(Failure::wrong)?;
        Ok(Self { bytes })
    }

    /// The images for the slots.
    pub fn links(&self) -> Vec<SlotImage<'_>> {
        // The bytes were parsed before.
        UpdateFile::parse(&self.bytes).map_or(Vec::new(), |file| file.links().copied().collect())
    }

    /// The address of a slot, and the bytes that a debug probe writes there.
    ///
    /// # Errors
    /// The file has no firmware for the slot, or is for a board that this program does not know.
    pub fn flat(&self, slot: Slot) -> Result<(u32, Vec<u8>), Failure> {
        let links = self.links();
        let link = links.iter().find(|link| link.header.slot() == slot);
        let link =
            link.ok_or_else(|| Failure::wrong(format!("the file has no firmware for slot {slot:?}")))?;
        let board = link.header.parts().board;
        let layout = Layout::of(board.as_str())
            .ok_or_else(|| Failure::wrong(format!("where the slots of {board} are is not known here")))?;
        let mut bytes = link.header_bytes.to_vec();
        bytes.resize(IMAGE_OFFSET as usize, 0xFF);
        bytes.extend(link.image);
        Ok((layout.slot(slot), bytes))
    }

    /// The content, and whether it is what was signed.
    pub fn inspect(&self, public: Option<&Path>, view: TableView) -> Result<Answer, Failure> {
        let key = public.map(signing_key::read_public).transpose()?;
        let links = self.links();
        let mut table = TextTable::new(&["slot", "address", "bytes", "SHA-512", "contents", "signature"]);
        let (mut is_well, mut rows) = (true, Vec::new());
        for link in &links {
            let contents = link.check();
            let signature = key.as_ref().map(|key| link.header.verify(key));
            is_well &= contents.is_ok() && !matches!(signature, Some(Err(_)));
            let slot = format!("{:?}", link.header.slot());
            let layout = Layout::of(link.header.parts().board.as_str());
            let address = layout.map(|layout| format!("{:08X}", layout.slot(link.header.slot())));
            let digits = Hex(&link.header.hash()[..]).to_string();
            let contents = contents.map_or_else(|why| why.to_string(), |()| "whole".to_owned());
            let signature = match signature {
                Some(Ok(())) => "of this key",
                Some(Err(_)) => "of another key",
                None => "not checked",
            };
            rows.push(json!({
                "slot": &slot,
                "address": &address,
                "length": link.header.length(),
                "sha512": &digits,
                "contents": &contents,
                "signature": signature,
            }));
            table.row([
                slot.into(),
                address.unwrap_or_else(|| "?".to_owned()).into(),
                TableCell::number(link.header.length()),
                digits[..16].into(),
                looked(contents, "whole"),
                looked(signature.to_owned(), "of this key"),
            ]);
        }
        let Some(SlotImage { header, .. }) = links.first() else {
            return Err(Failure::wrong("the file is empty"));
        };
        let ImageFacts { board, version, formats, store, .. } = header.parts();
        let Formats { oldest, newest, written } = *formats;
        let mut text = facts([
            ("firmware", version.to_string().into()),
            ("board", board.to_string().into()),
            ("configurations", format!("reads versions {oldest} to {newest}, writes {written}").into()),
            ("store", format!("version {store}").into()),
        ]);
        text.push('\n');
        text.push_str(&table.show(view));
        let document = json!({
            "version": version.to_string(),
            "board": board.as_str(),
            "reads": [oldest, newest],
            "writes": written,
            "store": store,
            "links": rows,
        });
        Ok(Answer::new(document, text).with_verdict(is_well))
    }

    /// One line with the content, and the key that the signature belongs to.
    pub fn summary(&self, public: &PublicKey) -> String {
        let links = self.links();
        let sizes: Vec<String> = links
            .iter()
            .map(|link| format!("slot {:?} {} bytes", link.header.slot(), link.image.len() + HEADER))
            .collect();
        let Some(SlotImage { header, .. }) = links.first() else { return String::new() };
        let (version, board) = (header.version(), header.parts().board);
        format!("firmware {version} for {board}: {}; signed for {}", sizes.join(", "), Hex(&public.bytes()))
    }
}

/// The public key that belongs to a private one.
pub fn public_of(path: &Path) -> Result<PublicKey, Failure> {
    signing_key::read(path).map(|seed| PublicKey::of_seed(&seed.0))
}

fn looked(text: String, well: &str) -> TableCell {
    let look = match text.as_str() {
        "not checked" => Look::Warning,
        text if text == well => Look::Well,
        _ => Look::Wrong,
    };
    TableCell::of(text).look(look)
}
