//! An option for statics that are all zeros.

/// An option that is all zeros when there is nothing, whatever could be in it: so a node that is not made yet takes no
/// flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Maybe<T> {
    Nothing,
    Just(T),
}

impl<T: Copy> Maybe<T> {
    pub(super) const fn get(self) -> Option<T> {
        match self {
            Self::Nothing => None,
            Self::Just(value) => Some(value),
        }
    }
}
