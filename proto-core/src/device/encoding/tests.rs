use std::string::String;
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;

fn of(kind: Kind, order: ByteOrder) -> Encoding {
    Encoding { kind, order, shared: false }
}

fn decimal(width: Width, decimals: u8) -> Encoding {
    of(Kind::Decimal(Digits { width, decimals }), ByteOrder::Little)
}

fn bits(bytes: u8, first: u8, count: u8, signed: bool) -> Encoding {
    of(Kind::Bits(Bits { bytes, first, count, signed }), ByteOrder::Little)
}

fn written(encoding: Encoding, value: f64) -> Vec<u8> {
    let mut out = [0; 20];
    let fitting = encoding.fit(value, Overflow::Usual).unwrap();
    let len = encoding.write(fitting, &mut out).unwrap();
    out[..len].to_vec()
}

fn text(encoding: Encoding, value: f64) -> String {
    String::from_utf8(written(encoding, value)).unwrap()
}

#[test]
fn words_are_read_in_the_order_of_their_device() {
    let word = Kind::Scalar(ScalarType::Word);
    assert_eq!(of(word, ByteOrder::Big).read(&[0x12, 0x34]), Ok(Scalar::Word(0x1234)));
    assert_eq!(of(word, ByteOrder::Little).read(&[0x12, 0x34]), Ok(Scalar::Word(0x3412)));
    let float = Kind::Scalar(ScalarType::Float);
    // 1.5 is 0x3FC00000.
    assert_eq!(of(float, ByteOrder::BigSwapped).read(&[0, 0, 0x3F, 0xC0]), Ok(Scalar::Float(1.5)));
    assert_eq!(written(of(float, ByteOrder::LittleSwapped), 1.5), [0xC0, 0x3F, 0, 0]);
}

#[test]
fn three_bytes_have_a_sign_or_not() {
    let bytes = [0xFF, 0xFF, 0xFE];
    assert_eq!(of(Kind::Uint24, ByteOrder::Big).read(&bytes), Ok(Scalar::Dword(0xFF_FFFE)));
    assert_eq!(of(Kind::Int24, ByteOrder::Big).read(&bytes), Ok(Scalar::Int(-2)));
    assert_eq!(written(of(Kind::Int24, ByteOrder::Big), -2.0), bytes);
    assert_eq!(written(of(Kind::Int24, ByteOrder::Little), -9e9), [0, 0, 0x80], "the lowest");
}

#[test]
fn bcd_is_two_digits_a_byte() {
    let bcd = of(Kind::Bcd { bytes: 2 }, ByteOrder::Big);
    assert_eq!(bcd.read(&[0x12, 0x34]), Ok(Scalar::Dword(1234)));
    assert_eq!(bcd.read(&[0x1A, 0x34]), Err(Unreadable::NotADigit));
    assert_eq!(written(bcd, 987.0), [0x09, 0x87]);
    assert_eq!(written(bcd, 12_345.0), [0x99, 0x99]);
    assert_eq!(of(Kind::Bcd { bytes: 4 }, ByteOrder::Big).range(), (0.0, 99_999_999.0));
}

#[test]
fn bits_are_cut_out_and_put_in() {
    assert_eq!(bits(1, 4, 4, false).read(&[0xA5]), Ok(Scalar::Dword(0xA)));
    assert_eq!(bits(1, 4, 4, true).read(&[0xA5]), Ok(Scalar::Int(-6)));
    assert_eq!(bits(4, 0, 32, false).read(&[0xFF; 4]), Ok(Scalar::Dword(u32::MAX)));
    let mut out = [0x05];
    assert_eq!(bits(1, 4, 4, true).write(-6.0, &mut out), Some(1));
    assert_eq!(out, [0xA5]);
    let big = Encoding { order: ByteOrder::Big, ..bits(2, 8, 1, false) };
    assert_eq!(written(big, 1.0), [1, 0]);
}

#[test]
fn decimal_digits_are_read_as_people_and_scales_write_them() {
    for (text, value) in [
        ("0042", Scalar::Int(42)),
        ("  42", Scalar::Int(42)),
        ("+42", Scalar::Int(42)),
        ("-  12.50", Scalar::Double(-12.5)),
        ("-0", Scalar::Int(0)),
        (".5", Scalar::Double(0.5)),
        ("0.1", Scalar::Double(0.1)),
        ("2147483648", Scalar::Double(2_147_483_648.0)),
    ] {
        assert_eq!(decimal(Width::Until(b','), 0).read(text.as_bytes()), Ok(value), "{text}");
    }
    for text in ["", "-", ".", "1.2.3", "1e3", "NaN", "12a", "--1", "0x10", "1 2"] {
        assert_eq!(
            decimal(Width::Until(b','), 0).read(text.as_bytes()),
            Err(Unreadable::NotADigit),
            "{text:?}"
        );
    }
    assert_eq!(decimal(Width::Until(b','), 0).read(b"9999999999999999"), Err(Unreadable::TooLarge));
    assert_eq!(decimal(Width::Fixed(3), 0).read(b"1234"), Err(Unreadable::Length));
}

#[test]
fn decimal_digits_are_written_at_their_width() {
    assert_eq!(text(decimal(Width::Fixed(5), 0), 42.0), "00042");
    assert_eq!(text(decimal(Width::Fixed(5), 0), -42.0), "-0042");
    assert_eq!(text(decimal(Width::Fixed(6), 2), 3.249), "003.25");
    assert_eq!(text(decimal(Width::Fixed(6), 2), -3.249), "-03.25");
    assert_eq!(text(decimal(Width::Fixed(3), 0), 5000.0), "999");
    assert_eq!(text(decimal(Width::Fixed(3), 0), -5000.0), "-99");
    assert_eq!(text(decimal(Width::Until(b','), 0), 0.0), "0");
    assert_eq!(text(decimal(Width::Until(b','), 0), -7.0), "-7");
    assert_eq!(text(decimal(Width::Until(b','), 2), 0.05), "0.05");
    assert_eq!(text(decimal(Width::Until(b','), 2), -0.05), "-0.05");
    assert_eq!(text(decimal(Width::Fixed(16), 3), 1e300), "999999999999.999");
}

#[test]
fn hexadecimal_digits_are_read_in_both_cases_and_written_in_capitals() {
    let hex = of(Kind::Hex(Width::Fixed(4)), ByteOrder::Little);
    assert_eq!(hex.read(b"00fF"), Ok(Scalar::Dword(255)));
    assert_eq!(hex.read(b"00 F"), Err(Unreadable::NotADigit));
    assert_eq!(text(hex, 255.0), "00FF");
    assert_eq!(text(hex, 1e9), "FFFF");
    let open = of(Kind::Hex(Width::Until(b'\r')), ByteOrder::Little);
    assert_eq!(open.read(b"1FFFFFFFF"), Err(Unreadable::TooLarge));
    assert_eq!(open.read(b""), Err(Unreadable::Length));
    assert_eq!(text(open, 4096.0), "1000");
}

#[test]
fn numbers_wrap_only_where_asked() {
    let byte = Encoding::scalar(ScalarType::Byte);
    assert_eq!(byte.fit(300.0, Overflow::Usual), Some(255.0));
    assert_eq!(byte.fit(300.0, Overflow::Wrap), Some(44.0));
    assert_eq!(byte.fit(-1.0, Overflow::Wrap), Some(255.0));
    let short = Encoding::scalar(ScalarType::Short);
    assert_eq!(short.fit(40_000.0, Overflow::Wrap), Some(40_000.0 - 65_536.0));
    assert_eq!(of(Kind::Bcd { bytes: 1 }, ByteOrder::Big).fit(123.0, Overflow::Wrap), Some(23.0));
    assert_eq!(byte.fit(f64::NAN, Overflow::Usual), None);
    assert_eq!(byte.fit(f64::INFINITY, Overflow::Usual), Some(255.0));
    assert_eq!(byte.fit(f64::INFINITY, Overflow::Wrap), None);
    // Floats do not wrap.
    assert_eq!(Encoding::scalar(ScalarType::Float).fit(1e300, Overflow::Wrap), Some(f64::from(f32::MAX)));
}

fn any_encoding() -> impl Strategy<Value = Encoding> {
    let order = prop_oneof![
        Just(ByteOrder::Little),
        Just(ByteOrder::Big),
        Just(ByteOrder::BigSwapped),
        Just(ByteOrder::LittleSwapped)
    ];
    let width = prop_oneof![(1_u8..=16).prop_map(Width::Fixed), Just(Width::Until(b';'))];
    let kind = prop_oneof![
        prop::sample::select(&ScalarType::ALL[..]).prop_map(Kind::Scalar),
        Just(Kind::Uint24),
        Just(Kind::Int24),
        (1_u8..=4).prop_map(|bytes| Kind::Bcd { bytes }),
        (width.clone(), 0_u8..4).prop_map(|(width, decimals)| Kind::Decimal(Digits { width, decimals })),
        prop_oneof![(1_u8..=8).prop_map(Width::Fixed), Just(Width::Until(b';'))].prop_map(Kind::Hex),
        (prop::sample::select(vec![1_u8, 2, 4]), any::<[u8; 2]>(), any::<bool>()).prop_map(
            |(bytes, [first, count], signed)| {
                let first = first % (8 * bytes);
                let count = 1 + count % (8 * bytes - first);
                Kind::Bits(Bits { bytes, first, count, signed })
            }
        ),
    ];
    (kind, order)
        .prop_map(|(kind, order)| Encoding { kind, order, shared: false })
        .prop_filter("words are swapped in whole words", |encoding| {
            !encoding.order.swaps_words() || encoding.size().is_none_or(|len| len % 2 == 0)
        })
        .prop_filter("digits before and behind a point", |encoding| match encoding.kind {
            Kind::Decimal(Digits { width: Width::Fixed(width), decimals }) if decimals > 0 => {
                width >= decimals + 3
            }
            _ => true,
        })
}

proptest! {
    #[test]
    fn what_is_written_reads_back(encoding in any_encoding(), value in any::<f64>()) {
        let Some(fitting) = encoding.fit(value, Overflow::Usual) else { return Ok(()) };
        let mut out = [0; 20];
        let len = encoding.write(fitting, &mut out).unwrap();
        prop_assert_eq!(encoding.size().unwrap_or(len), len);
        let read = encoding.read(&out[..len]).unwrap().as_f64();
        let expected = match encoding.kind {
            Kind::Scalar(ScalarType::Float) => f64::from(fitting as f32),
            Kind::Decimal(Digits { decimals, .. }) => {
                let unit = power_of_ten(decimals);
                round(fitting * unit) / unit
            }
            _ => fitting,
        };
        prop_assert_eq!(read, expected, "{:?} of {}", encoding, value);
    }

    #[test]
    fn any_small_number_survives(encoding in any_encoding(), value in -200_i32..200) {
        let (low, high) = encoding.range();
        let value = f64::from(value);
        prop_assume!(low <= value && value <= high);
        prop_assert_eq!(encoding.fit(value, Overflow::Wrap), Some(value));
        let mut out = [0; 20];
        let len = encoding.write(value, &mut out).unwrap();
        prop_assert_eq!(encoding.read(&out[..len]).unwrap().as_f64(), value);
    }

    #[test]
    fn any_bytes_are_a_value_or_refused(
        encoding in any_encoding(),
        bytes in prop::collection::vec(any::<u8>(), 0..20),
    ) {
        if let Ok(value) = encoding.read(&bytes) {
            let (low, high) = encoding.range();
            let number = value.as_f64();
            // Received numbers may have more digits after the point than sent ones.
            if value.is_finite() && !matches!(encoding.kind, Kind::Decimal(_)) {
                prop_assert!(low <= number && number <= high, "{:?} is {}", encoding, number);
            }
        }
    }
}

/// Signals of CAN databases: 12 bits from bit 28 of an 8-byte message, in its bytes 3 and 4, and the same in Motorola
/// order.
#[test]
fn bits_of_eight_bytes_cross_any_byte() {
    let intel = Encoding::bits_of(8, 28..=39);
    let mut bytes = [0; 8];
    assert_eq!(intel.write(f64::from(0xABC), &mut bytes), Some(8));
    assert_eq!(bytes, [0, 0, 0, 0xC0, 0xAB, 0, 0, 0]);
    assert_eq!(intel.read(&bytes), Ok(Scalar::Dword(0xABC)));
    let motorola = Encoding { order: ByteOrder::Big, ..intel };
    let mut bytes = [0; 8];
    motorola.write(f64::from(0xABC), &mut bytes);
    assert_eq!(bytes, [0, 0, 0, 0xAB, 0xC0, 0, 0, 0]);
    // Adjacent fields, signed, and of the maximum width.
    let highest = Encoding::bits_of(8, 32..=63).signed();
    highest.write(-2.0, &mut bytes);
    assert_eq!(highest.read(&bytes), Ok(Scalar::Int(-2)));
    assert_eq!(bytes, [0, 0, 0, 0xAB, 0xFE, 0xFF, 0xFF, 0xFF]);
}
