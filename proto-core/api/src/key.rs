//! The key of a gateway: 128 random bits, and how a client proves that it has them.
//!
//! On one machine the client sends the key itself (`Bearer`). Over a network, where others can listen, it never does:
//! it signs each request (docs/api.md section 3). All comparisons take constant time.

use core::fmt;

use hmac::{Hmac, KeyInit, Mac};
use sha2::{Digest, Sha256};

/// Length of a key in bytes.
pub const KEY_LEN: usize = 16;
/// The `Authorization` scheme of signed requests.
pub const SCHEME: &str = "RGW-HMAC-SHA256";

/// A SHA-256 hash.
pub type Hash = [u8; 32];

/// A key. It is never shown, not even by `Debug`.
#[derive(Clone)]
pub struct Key([u8; KEY_LEN]);

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key")
    }
}

impl Key {
    /// Makes a key from its bytes.
    pub const fn new(bytes: [u8; KEY_LEN]) -> Self {
        Self(bytes)
    }

    /// Parses a key of 32 hexadecimal digits. `None` if the text is anything else, or all digits are equal.
    pub fn parse(text: &str) -> Option<Self> {
        let bytes: [u8; KEY_LEN] = from_hex(text)?;
        let first = *bytes.first()?;
        let is_filler = bytes.iter().all(|&byte| byte == first) && first >> 4 == first & 15;
        (!is_filler).then_some(Self(bytes))
    }

    /// Whether `text` is this key in hexadecimal. The time depends only on the length of `text`: both are hashed with a
    /// random `secret` before they are compared.
    pub fn is(&self, text: &str, secret: &Hash) -> bool {
        let Some(shown) = from_hex::<KEY_LEN>(text) else { return false };
        is_same(&authenticate(secret, &[&shown]), &authenticate(secret, &[&self.0]), secret)
    }

    /// The signature of a request.
    pub fn sign(&self, what: &Signed<'_>) -> Hash {
        authenticate(&self.0, &what.parts())
    }

    /// Whether `signature` is the signature of this request.
    pub fn verify(&self, what: &Signed<'_>, signature: &Hash) -> bool {
        verify(&self.0, &what.parts(), signature)
    }
}

/// The fields that a signature covers, with a line feed after each of the four.
#[derive(Debug, Clone, Copy)]
pub struct Signed<'a> {
    /// The nonce, as text.
    pub nonce: &'a str,
    /// The method.
    pub method: &'a str,
    /// Path and query, as sent.
    pub target: &'a str,
    /// The SHA-256 of the body, as 64 lower-case hexadecimal digits.
    pub body: &'a str,
}

impl<'a> Signed<'a> {
    fn parts(&self) -> [&'a [u8]; 8] {
        let line = &b"\n"[..];
        let Self { nonce, method, target, body } = self;
        [nonce.as_bytes(), line, method.as_bytes(), line, target.as_bytes(), line, body.as_bytes(), line]
    }
}

/// Computes the hash of a body that arrives in pieces.
#[derive(Debug, Clone, Default)]
pub struct BodyHash(Sha256);

impl BodyHash {
    /// The hash of no bytes yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a piece.
    pub fn update(&mut self, piece: &[u8]) {
        self.0.update(piece);
    }

    /// The hash.
    pub fn finish(self) -> Hash {
        self.0.finalize().into()
    }
}

/// HMAC-SHA-256 over `parts`.
pub(crate) fn authenticate(key: &[u8], parts: &[&[u8]]) -> Hash {
    match mac(key, parts) {
        Some(mac) => mac.finalize().into_bytes().into(),
        None => [0; 32],
    }
}

pub(crate) fn verify(key: &[u8], parts: &[&[u8]], expected: &[u8]) -> bool {
    mac(key, parts).is_some_and(|mac| mac.verify_truncated_left(expected).is_ok())
}

/// Never `None`: HMAC accepts keys of any length.
fn mac(key: &[u8], parts: &[&[u8]]) -> Option<Hmac<Sha256>> {
    let mut mac = Hmac::<Sha256>::new_from_slice(key).ok()?;
    parts.iter().for_each(|part| mac.update(part));
    Some(mac)
}

/// Whether two hashes are equal, in constant time.
fn is_same(one: &Hash, other: &Hash, secret: &Hash) -> bool {
    verify(secret, &[one], &authenticate(secret, &[other]))
}

/// Decodes exactly `N` pairs of hexadecimal digits.
pub fn from_hex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let (pairs, []) = text.as_bytes().as_chunks::<2>() else { return None };
    if pairs.len() != N {
        return None;
    }
    let mut bytes = [0; N];
    for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
        let digit = |digit: &u8| char::from(*digit).to_digit(16);
        *byte = (digit(high)? << 4 | digit(low)?) as u8;
    }
    Some(bytes)
}

/// Displays bytes as lower-case hexadecimal digits.
#[derive(Debug, Clone, Copy)]
pub struct Hex<'a>(pub &'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::format;

    #[test]
    fn a_key_is_32_digits_and_no_filler() {
        let text = "000102030405060708090a0b0c0d0eFF";
        let key = Key::parse(text).unwrap();
        let secret = [3; 32];
        assert!(key.is(text, &secret) && key.is(&text.to_uppercase(), &secret));
        for wrong in [
            "",
            "0",
            &text[1..],
            &format!("{text}0"),
            &format!(" {}", &text[1..]),
            &format!("+{}", &text[1..]),
        ] {
            assert!(Key::parse(wrong).is_none(), "{wrong:?}");
            assert!(!key.is(wrong, &secret), "{wrong:?}");
        }
        assert!(!key.is("100102030405060708090a0b0c0d0eff", &secret));
        assert!(!key.is("000102030405060708090a0b0c0d0efe", &secret));
        assert!(Key::parse(&"0".repeat(32)).is_none());
        assert!(Key::parse(&"77".repeat(16)).is_none());
        assert_eq!(format!("{key:?}"), "Key");
    }

    /// RFC 4231, test case 2.
    #[test]
    fn the_code_is_that_of_the_standard() {
        let code = authenticate(b"Jefe", &[b"what do ya want ", b"for nothing?"]);
        let expected = "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843";
        assert_eq!(format!("{}", Hex(&code)), expected);
        let mut body = BodyHash::new();
        body.update(b"ab");
        body.update(b"c");
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(format!("{}", Hex(&body.finish())), expected);
    }

    /// The example of docs/api.md, where it is computed with openssl.
    #[test]
    fn a_signature_covers_all_four() {
        let key = Key::parse("00112233445566778899aabbccddeeff").unwrap();
        let body = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        let right = Signed { nonce: "0f", method: "POST", target: "/api/v1/confirm", body };
        let signature = key.sign(&right);
        assert!(key.verify(&right, &signature));
        for wrong in [
            Signed { nonce: "0e", ..right },
            Signed { method: "PUT", ..right },
            Signed { target: "/api/v1/rollback", ..right },
            Signed { body: "e3", ..right },
        ] {
            assert!(!key.verify(&wrong, &signature), "{wrong:?}");
        }
        let mut flipped = signature;
        flipped[31] ^= 1;
        assert!(!key.verify(&right, &flipped));
        assert!(!Key::new([1; 16]).verify(&right, &signature));
    }
}
