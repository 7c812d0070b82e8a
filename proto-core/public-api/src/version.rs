//! Versions as Cargo compares them.

/// Whether Cargo takes `new` where `old` is required.
///
/// # Errors
/// A version that is not three numbers.
pub(crate) fn is_compatible(old: &str, new: &str) -> Result<bool, String> {
    let (old, new) = (numbers(old)?, numbers(new)?);
    let promised = |version: [u64; 3]| match version {
        [0, 0, patch] => [0, 0, patch],
        [0, minor, _] => [0, minor, 0],
        [major, _, _] => [major, 0, 0],
    };
    Ok(new >= old && promised(old) == promised(new))
}

fn numbers(version: &str) -> Result<[u64; 3], String> {
    let numbers: Result<Vec<u64>, _> = version.trim().split('.').map(str::parse).collect();
    let numbers = numbers.ok().and_then(|numbers| numbers.try_into().ok());
    numbers.ok_or_else(|| format!("`{version}` is not three numbers"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_number_that_is_not_zero_promises() {
        assert_eq!(is_compatible("0.2.0", "0.2.1"), Ok(true));
        assert_eq!(is_compatible("0.2.0", "0.3.0"), Ok(false));
        assert_eq!(is_compatible("1.2.0", "1.3.0"), Ok(true));
        assert_eq!(is_compatible("1.2.0", "2.0.0"), Ok(false));
        assert_eq!(is_compatible("0.0.1", "0.0.2"), Ok(false));
        assert!(is_compatible("unreleased", "0.2.0").is_err());
    }
}
