//! Wider registers where the processor has them.

/// Defines `fn name(…)`, with or without a result, which calls the `#[inline(always)]` function `body`
/// compiled for AVX2 where the processor has it, and as it is elsewhere.
///
/// Nothing but the width changes: Rust neither reorders nor fuses floating-point operations, so
/// either way the same operations give the same bits.
macro_rules! widened {
    (
        $(#[$attribute:meta])*
        $visibility:vis fn $name:ident = $body:path, ($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)?
    ) => {
        $(#[$attribute])*
        $visibility fn $name($($argument: $type),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($argument: $type),*) $(-> $result)? {
                    $body($($argument),*)
                }
                if std::is_x86_feature_detected!("avx2") {
                    #[expect(unsafe_code, reason = "the processor was asked")]
                    // SAFETY: the processor has AVX2, as just asked.
                    return unsafe { wide($($argument),*) };
                }
            }
            $body($($argument),*)
        }
    };
}

pub(crate) use widened;

/// `1.5 · 2²³`: a float of magnitude below 2²² added to it has no room for its fraction.
const SHIFT: f32 = 12_582_912.0;

/// `value` rounded to the nearest integer, halves to the even one, for magnitudes below 2²²; in
/// two additions, where a call of the library would keep a loop from being widened.
#[inline(always)]
pub(crate) fn round_i32(value: f32) -> i32 {
    (value + SHIFT).to_bits().wrapping_sub(SHIFT.to_bits()) as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_halves_to_even() {
        for n in -40_000..40_000 {
            let value = n as f32 / 8.0;
            assert_eq!(round_i32(value), value.round_ties_even() as i32, "{value}");
        }
        assert_eq!(round_i32(4_194_303.0), 4_194_303);
        assert_eq!(round_i32(-4_194_303.0), -4_194_303);
    }
}
