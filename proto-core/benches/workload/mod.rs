//! What the benchmarks measure, each piece of work beside its bare limit: the same bytes moved by
//! code that was written for one recipe, with every offset a constant and no check of the values.

use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{CanLayout, Deframer, NoSpace, StreamLayout};
use proto_core::sysvar::{Direction, IMAGE_BYTES, SysVar, VarRange};
use proto_core::wire::can::{CanFrame, CanId};

type Image = [u8; IMAGE_BYTES];

pub(crate) const HEAD: [u8; 2] = [0xFF, 0xFF];
pub(crate) const TAIL: [u8; 2] = [0xFE, 0xFE];
pub(crate) const PAYLOAD: usize = 24;
pub(crate) const FRAME: usize = HEAD.len() + PAYLOAD + TAIL.len();
const POSE: &str = "RobotState[8..13]";
/// Where the pose stands in the image.
const POSE_PLACE: usize = 289;

/// Frames in one pass over a workload.
pub(crate) const FRAMES: usize = 1000;

const SEED: u64 = 0x9E37_79B9_7F4A_7C15;

/// Numbers that look random and are the same in every run.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % limit
    }
}

fn system(names: &str) -> impl Iterator<Item = Field> {
    VarRange::parse(names).unwrap().iter().map(Field::System)
}

fn image_offset(name: &str) -> usize {
    SysVar::parse(name).unwrap().image_offset()
}

/// A line in chunks of 1..=64 bytes, and what reads pose frames from it.
pub(crate) struct Stream {
    line: Vec<u8>,
    chunks: Vec<usize>,
    layout: StreamLayout,
    deframer: Deframer,
    bare: BareDeframer,
    image: Image,
}

impl Stream {
    /// Pose frames with 1 % garbage between them.
    pub(crate) fn frames() -> Self {
        let mut random = Random(SEED);
        let mut line = Vec::new();
        for _ in 0..FRAMES {
            line.extend(HEAD);
            for _ in 0..PAYLOAD / 4 {
                line.extend((random.below(2_000_000) as f32 / 1e6 - 1.0).to_le_bytes());
            }
            line.extend(TAIL);
            for _ in 0..FRAME {
                if random.below(100) == 0 {
                    line.push(random.below(256) as u8);
                }
            }
        }
        Self::carrying(line, random).check()
    }

    /// The line's bytes, and the sizes of its chunks.
    #[allow(dead_code, reason = "for other libraries; the benchmarks do not look at them")]
    pub(crate) fn into_line(self) -> (Vec<u8>, Vec<usize>) {
        (self.line, self.chunks)
    }

    /// As many bytes without a frame.
    pub(crate) fn noise() -> Self {
        let mut random = Random(SEED);
        let line = (0..FRAMES * FRAME).map(|_| random.below(256) as u8).collect();
        Self::carrying(line, random)
    }

    /// As many bytes each of which begins a head that has no tail.
    pub(crate) fn heads() -> Self {
        Self::carrying(vec![HEAD[0]; FRAMES * FRAME], Random(SEED))
    }

    fn carrying(line: Vec<u8>, mut random: Random) -> Self {
        let mut chunks = Vec::new();
        let mut left = line.len();
        while left > 0 {
            let size = (1 + random.below(64) as usize).min(left);
            chunks.push(size);
            left -= size;
        }
        let rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
        let layout = StreamLayout::new(rules, &HEAD, &TAIL, system(POSE), Framing::Bytes).unwrap();
        Self {
            line,
            chunks,
            layout,
            deframer: Deframer::new(),
            bare: BareDeframer { held: [0; FRAME], len: 0 },
            image: [0; IMAGE_BYTES],
        }
    }

    /// Both ways must have found every frame and the same last values.
    fn check(mut self) -> Self {
        assert_eq!(image_offset("RobotState[8]"), POSE_PLACE);
        assert_eq!((self.decode(), self.decode_bare()), (FRAMES, FRAMES));
        self.image.fill(0);
        self.decode();
        let decoded = std::mem::replace(&mut self.image, [0; IMAGE_BYTES]);
        self.decode_bare();
        assert_eq!(decoded, self.image);
        self
    }

    /// Finds every frame and applies it to the image.
    #[inline(never)]
    pub(crate) fn decode(&mut self) -> usize {
        let mut frames = 0;
        let mut rest = &self.line[..];
        for &size in &self.chunks {
            let mut chunk;
            (chunk, rest) = rest.split_at(size);
            while let Some(payload) = self.deframer.next_frame(&self.layout, &mut chunk) {
                frames += usize::from(self.layout.apply(payload, &mut self.image).is_ok());
            }
        }
        frames
    }

    #[inline(never)]
    pub(crate) fn decode_bare(&mut self) -> usize {
        let mut frames = 0;
        let mut rest = &self.line[..];
        let pose = self.image[POSE_PLACE..].first_chunk_mut().unwrap();
        for &size in &self.chunks {
            let mut chunk;
            (chunk, rest) = rest.split_at(size);
            while self.bare.next(&mut chunk, pose) {
                frames += 1;
            }
        }
        frames
    }
}

/// The same search for the one frame format that it was written for.
struct BareDeframer {
    held: [u8; FRAME],
    len: usize,
}

impl BareDeframer {
    fn next(&mut self, chunk: &mut &[u8], out: &mut [u8; PAYLOAD]) -> bool {
        while self.len > 0 {
            let more = chunk.len().min(FRAME - self.len);
            self.held[self.len..self.len + more].copy_from_slice(&chunk[..more]);
            self.len += more;
            *chunk = &chunk[more..];
            if Self::may_begin(&self.held[..self.len]) {
                if self.len < FRAME {
                    return false;
                }
                if self.held[FRAME - TAIL.len()..] == TAIL {
                    out.copy_from_slice(&self.held[HEAD.len()..HEAD.len() + PAYLOAD]);
                    self.len = 0;
                    return true;
                }
            }
            let skip = (1..self.len).find(|&at| Self::may_begin(&self.held[at..self.len]));
            let skip = skip.unwrap_or(self.len);
            self.held.copy_within(skip..self.len, 0);
            self.len -= skip;
        }
        while !chunk.is_empty() {
            if !Self::may_begin(chunk) {
                *chunk = &chunk[1..];
                continue;
            }
            let Some(frame) = chunk.first_chunk::<FRAME>() else {
                self.held[..chunk.len()].copy_from_slice(chunk);
                self.len = chunk.len();
                *chunk = &[];
                return false;
            };
            if frame[FRAME - TAIL.len()..] == TAIL {
                out.copy_from_slice(&frame[HEAD.len()..HEAD.len() + PAYLOAD]);
                *chunk = &chunk[FRAME..];
                return true;
            }
            *chunk = &chunk[1..];
        }
        false
    }

    #[inline]
    fn may_begin(bytes: &[u8]) -> bool {
        match bytes.first_chunk() {
            Some(front) => *front == HEAD,
            None => bytes[0] == HEAD[0],
        }
    }
}

/// The pose of the image as a frame.
pub(crate) struct Encode {
    layout: StreamLayout,
    image: Image,
    out: Vec<u8>,
}

impl Encode {
    pub(crate) fn new() -> Self {
        let rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
        let layout = StreamLayout::new(rules, &HEAD, &TAIL, system(POSE), Framing::Bytes).unwrap();
        let image = std::array::from_fn(|at| at as u8);
        let mut new = Self { layout, image, out: vec![0; 64] };
        assert_eq!(new.encode(), FRAMES * FRAME);
        let encoded = std::mem::replace(&mut new.out, vec![0; 64]);
        assert_eq!(new.encode_bare(), FRAMES * FRAME);
        assert_eq!(encoded, new.out);
        new
    }

    #[inline(never)]
    pub(crate) fn encode(&mut self) -> usize {
        (0..FRAMES).map(|_| encode(&self.layout, &self.image, &mut self.out).unwrap_or(0)).sum()
    }

    #[inline(never)]
    pub(crate) fn encode_bare(&mut self) -> usize {
        (0..FRAMES).map(|_| encode_bare(&self.image, &mut self.out).unwrap_or(0)).sum()
    }
}

#[inline(never)]
fn encode(layout: &StreamLayout, image: &Image, out: &mut [u8]) -> Result<usize, NoSpace> {
    layout.encode(image, out)
}

/// The same for the one frame format that it was written for.
#[inline(never)]
fn encode_bare(image: &Image, out: &mut [u8]) -> Result<usize, NoSpace> {
    let available = out.len();
    let frame = out.first_chunk_mut::<FRAME>().ok_or(NoSpace { needed: FRAME, available })?;
    let (head, rest) = frame.split_at_mut(HEAD.len());
    let (payload, tail) = rest.split_at_mut(PAYLOAD);
    head.copy_from_slice(&HEAD);
    payload.copy_from_slice(&image[POSE_PLACE..POSE_PLACE + PAYLOAD]);
    tail.copy_from_slice(&TAIL);
    Ok(FRAME)
}

/// CAN frames of 16 ids, each with two floats.
pub(crate) struct Can {
    layout: CanLayout,
    frames: Vec<CanFrame>,
    /// For the bare limit: where each 11-bit id goes.
    places: Vec<u16>,
    image: Image,
}

const IDS: usize = 16;

impl Can {
    pub(crate) fn new() -> Self {
        let id = |nth: usize| CanId::Standard((0x201 + 7 * nth) as u16);
        let part = (0..IDS).map(|nth| {
            let names = format!("FloatOutputReg[{}..{}]", 2 * nth + 1, 2 * nth + 2);
            (id(nth), system(&names).collect::<Vec<_>>())
        });
        let rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
        let layout = CanLayout::new(rules, part).unwrap();
        let mut random = Random(SEED);
        let frames = (0..FRAMES).map(|_| {
            let value = (random.below(1000) as f32).to_le_bytes();
            let data = [value, value].concat();
            CanFrame::new(id(random.below(IDS as u64) as usize), &data).unwrap()
        });
        let frames = frames.collect();
        let mut places = vec![u16::MAX; 0x800];
        for nth in 0..IDS {
            let place = image_offset(&format!("FloatOutputReg[{}]", 2 * nth + 1));
            let CanId::Standard(id) = id(nth) else { unreachable!() };
            places[usize::from(id)] = place as u16;
        }
        let mut new = Self { layout, frames, places, image: [0; IMAGE_BYTES] };
        assert_eq!((new.decode(), new.decode_bare()), (FRAMES, FRAMES));
        new
    }

    /// The frames: id and data.
    #[allow(dead_code, reason = "for other libraries; the benchmarks do not look at them")]
    pub(crate) fn into_frames(self) -> Vec<(u32, Vec<u8>)> {
        let parts = |frame: CanFrame| {
            let CanId::Standard(id) = frame.id() else { unreachable!() };
            (u32::from(id), frame.data().to_vec())
        };
        self.frames.into_iter().map(parts).collect()
    }

    #[inline(never)]
    pub(crate) fn decode(&mut self) -> usize {
        let mut applied = 0;
        for received in &self.frames {
            let Ok(index) = self.layout.accept_frame(received) else { continue };
            let Some(frame) = self.layout.frame(index) else { continue };
            applied += usize::from(frame.apply(received.data(), &mut self.image).is_ok());
        }
        applied
    }

    #[inline(never)]
    pub(crate) fn decode_bare(&mut self) -> usize {
        let mut applied = 0;
        for received in &self.frames {
            let CanId::Standard(id) = received.id() else { continue };
            let place = usize::from(self.places[usize::from(id & 0x7FF)]);
            let Some(data) = received.data().first_chunk::<8>() else { continue };
            let Some(target) = self.image.get_mut(place..).and_then(|rest| rest.first_chunk_mut()) else {
                continue;
            };
            *target = *data;
            applied += 1;
        }
        applied
    }
}
