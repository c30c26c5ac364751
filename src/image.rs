//! A grey image: the only pixels that the stages see.

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

    /// Changes the size in place, keeping the allocation where it suffices; pixel values are
    /// unspecified afterwards.
    pub fn reshape(&mut self, width: u32, height: u32) {
        self.width = width;
        self.height = height;
        self.data.resize(width as usize * height as usize, 0);
    }
}
