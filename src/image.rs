//! A grey image: the only pixels that the stages see.

/// Bands of rows that an image is told from others by.
pub const BANDS: usize = 16;

/// An 8-bit grey image, row-major without padding; pixel centres at integer coordinates.
///
/// A colour or 16-bit source becomes one of these where it is decoded, so that every later stage
/// reads one form.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct GrayImage {
    width: u32,
    height: u32,
    data: Vec<u8>,
}

impl GrayImage {
    /// An image over `data`, which holds `width * height` bytes, row by row. `None` if it does not.
    #[must_use]
    pub fn from_vec(width: u32, height: u32, data: Vec<u8>) -> Option<Self> {
        (data.len() == width as usize * height as usize).then_some(Self {
            width,
            height,
            data,
        })
    }

    /// An image of one grey value.
    #[must_use]
    pub fn filled(width: u32, height: u32, value: u8) -> Self {
        Self {
            width,
            height,
            data: vec![value; width as usize * height as usize],
        }
    }

    /// Width in pixels.
    #[must_use]
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    #[must_use]
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels, row by row.
    #[must_use]
    pub fn pixels(&self) -> &[u8] {
        &self.data
    }

    /// All pixels, row by row, to be written to.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.data
    }

    /// All pixels, row by row, and the memory that they are in.
    #[must_use]
    pub fn into_vec(self) -> Vec<u8> {
        self.data
    }

    /// The pixels of row `y`.
    ///
    /// # Panics
    /// If `y` is not below the height, as a slice index does.
    #[must_use]
    pub fn row(&self, y: u32) -> &[u8] {
        let width = self.width as usize;
        &self.data[y as usize * width..][..width]
    }

    /// Of each of [`BANDS`] bands of rows, from the top, a number by which bands that differ in any pixel differ,
    /// but for chance; `None` for a band of one grey value, which says nothing of when it was taken.
    #[must_use]
    pub fn fingerprints(&self) -> [Option<u64>; BANDS] {
        let (width, height) = (self.width as usize, self.height as usize);
        let from = |band: usize| band * height / BANDS * width;
        std::array::from_fn(|band| {
            let hash = fingerprint(&self.data[from(band)..from(band + 1)])?;
            Some(mix(hash, self.width.into()))
        })
    }

    /// Changes the size in place, keeping the allocation where it suffices; pixel values are
    /// unspecified afterwards.
    pub fn reshape(&mut self, width: u32, height: u32) {
        self.width = width;
        self.height = height;
        self.data.resize(width as usize * height as usize, 0);
    }
}

fn mix(hash: u64, word: u64) -> u64 {
    const ODD: u64 = 0x9E37_79B9_7F4A_7C15;
    (hash ^ word).wrapping_mul(ODD).rotate_left(29)
}

fn fingerprint(bytes: &[u8]) -> Option<u64> {
    let first = *bytes.first()?;
    let mut lanes = [1_u64, 2, 3, 4];
    let mut is_uniform = true;
    let uniform = u64::from_ne_bytes([first; 8]);
    // Lanes that do not wait for each other.
    let mut blocks = bytes.chunks_exact(8 * lanes.len());
    for block in &mut blocks {
        for (lane, bytes) in lanes.iter_mut().zip(block.as_chunks::<8>().0) {
            let word = u64::from_ne_bytes(*bytes);
            is_uniform &= word == uniform;
            *lane = mix(*lane, word);
        }
    }
    for &byte in blocks.remainder() {
        is_uniform &= byte == first;
        lanes[0] = mix(lanes[0], u64::from(byte));
    }
    (!is_uniform).then(|| lanes.into_iter().fold(bytes.len() as u64, mix))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_tell_the_bands_apart_that_differ_in_any_pixel() {
        let (width, height) = (35, 2 * BANDS);
        let image = |change: Option<usize>| {
            let grey = |i: usize| (i * 7 % 251) as u8;
            let mut data: Vec<u8> = (0..width * height).map(grey).collect();
            if let Some(at) = change {
                data[at] ^= 1;
            }
            GrayImage::from_vec(width as u32, height as u32, data).expect("the size fits")
        };
        let of = |change| image(change).fingerprints();
        assert!(of(None).iter().all(Option::is_some));
        for at in 0..width * height {
            let changed = of(Some(at));
            for (band, (now, before)) in changed.iter().zip(of(None)).enumerate() {
                assert_eq!(*now != before, band == at / (2 * width), "{at} {band}");
            }
        }
        let other_shape = GrayImage::from_vec(70, BANDS as u32, image(None).into_vec());
        let other_shape = other_shape.expect("the size fits").fingerprints();
        assert!(other_shape.iter().zip(of(None)).all(|(a, b)| *a != b));
    }

    #[test]
    fn a_band_of_one_grey_value_has_no_fingerprint() {
        for size in [1, 31, 32, 33, 64] {
            let mut image = GrayImage::filled(size, BANDS as u32, 9);
            assert_eq!(image.fingerprints(), [None; BANDS]);
            if let Some(last) = image.pixels_mut().last_mut().filter(|_| size > 1) {
                *last = 8;
                let of = image.fingerprints();
                assert_eq!(of[..BANDS - 1], [None; BANDS - 1], "{size}");
                assert!(of[BANDS - 1].is_some(), "{size}");
            }
        }
        assert_eq!(GrayImage::default().fingerprints(), [None; BANDS]);
    }
}
