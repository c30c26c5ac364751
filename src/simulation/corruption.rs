//! A good stereo pair in, the same pair as a failing camera, cable or driver would have handed it on out.
//!
//! Every draw comes from the caller's random numbers: the same seed spoils the same pixels.

use crate::capture::{Side, StereoPair};
use crate::image::GrayImage;
use rand::RngExt;
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::{Deserialize, Serialize};

/// What has gone wrong with a run of consecutive pairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Corruption {
    /// Nothing: the measure of all others.
    None,
    /// Both images smeared along one direction, as a jolt does.
    Blur,
    /// Both images black.
    Black,
    /// One image black.
    BlackSide,
    /// Both images white.
    Saturated,
    /// The cables are the wrong way round.
    Swapped,
    /// Pairs arrive last first, each with its own stamp.
    Reversed,
    /// Both images are those of the pair before, to the byte.
    Frozen,
    /// One image is that of the pair before, to the byte.
    FrozenSide,
    /// Both images are those of some pairs ago, to the byte.
    Stale,
    /// One image was taken some pairs earlier or later, and is not handed on twice.
    LateSide,
    /// Both images come some pairs late and are stamped as if they did not; none is handed on twice.
    LateBoth,
    /// Noise far beyond the sensor's.
    Noise,
    /// The lower part of both images is still that of the pair before.
    HalfOld,
    /// The lower part of one image is still that of the pair before.
    HalfOldSide,
    /// The lower part of both images comes one pair late, and is not handed on twice. The truth is that of the larger
    /// part.
    HalfLate,
    /// The lower part of both images is black.
    HalfBlack,
    /// The lower part of one image is displaced along its rows, as by lost bytes.
    Torn,
    /// Bands of rows are missing, as of lost packets.
    Bands,
    /// Something of rich texture moves across a third of both images.
    Mover,
    /// A hand covers a third of both images.
    Cover,
    /// Both exposures jump.
    Exposure,
    /// The exposure of one camera jumps.
    ExposureSide,
    /// Something greasy is on a lens.
    Smear,
    /// One image is displaced by a few pixels, as by a wrong offset on the sensor.
    Displaced,
    /// Both images show some other place, where the cameras stand still.
    OtherPlace,
    /// One image shows some other place.
    OtherPlaceSide,
    /// Both images are exposed for so long that most of them is white.
    OverExposed,
}

impl Corruption {
    /// Every one.
    pub const ALL: [Self; 28] = [
        Self::None,
        Self::Blur,
        Self::Black,
        Self::BlackSide,
        Self::Saturated,
        Self::Swapped,
        Self::Reversed,
        Self::Frozen,
        Self::FrozenSide,
        Self::Stale,
        Self::LateSide,
        Self::LateBoth,
        Self::Noise,
        Self::HalfOld,
        Self::HalfOldSide,
        Self::HalfLate,
        Self::HalfBlack,
        Self::Torn,
        Self::Bands,
        Self::Mover,
        Self::Cover,
        Self::Exposure,
        Self::ExposureSide,
        Self::Smear,
        Self::Displaced,
        Self::OtherPlace,
        Self::OtherPlaceSide,
        Self::OverExposed,
    ];
}

impl std::fmt::Display for Corruption {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// The good pairs that a run of spoilt ones is made from.
#[derive(Clone, Copy)]
pub struct Material<'a> {
    /// The pairs as they should have been, in order.
    pub pairs: &'a [StereoPair],
    /// A pair of some other place, of the same size.
    pub other_place: &'a StereoPair,
}

/// What all pairs of one run share, drawn once.
pub struct Spoiler<'a> {
    kind: Corruption,
    material: Material<'a>,
    first: usize,
    count: usize,
    side: Side,
    /// How many pairs an image is late or, where negative, early.
    lag: isize,
    /// How severe it is, 0 to 1.
    strength: f64,
    /// Where an image is cut, share of its height.
    cut: f64,
    direction_rad: f64,
    texture: GrayImage,
    rng: Xoshiro256PlusPlus,
}

/// Pairs that an image is late at most.
pub const MAX_LAG: usize = 4;

/// A spoilt pair, and which of the good ones its left image shows: the truth is that one's.
pub struct Spoilt {
    /// The pair as it arrives.
    pub pair: StereoPair,
    /// Index of the good pair whose pose its row should have.
    pub truth: usize,
}

impl<'a> Spoiler<'a> {
    /// Spoils `count` pairs from `first` on, which has at least [`MAX_LAG`] pairs before and behind the run.
    #[must_use]
    pub fn new(
        kind: Corruption,
        material: Material<'a>,
        [first, count]: [usize; 2],
        mut rng: Xoshiro256PlusPlus,
    ) -> Self {
        let side = if rng.random() {
            Side::Left
        } else {
            Side::Right
        };
        let size: i64 = rng.random_range(1..=MAX_LAG as i64);
        let early = kind == Corruption::LateSide && rng.random::<bool>();
        let image = &material.pairs[first].left;
        Self {
            kind,
            material,
            first,
            count,
            side,
            lag: if early { -size as isize } else { size as isize },
            strength: rng.random(),
            cut: rng.random_range(0.3..0.7),
            direction_rad: rng.random_range(0.0..std::f64::consts::TAU),
            texture: blotches(image.width(), image.height(), &mut rng),
            rng,
        }
    }

    /// What arrives in place of pair `index`, one of the run.
    #[must_use]
    pub fn pair(&mut self, index: usize) -> Spoilt {
        let pairs = self.material.pairs;
        let mut pair = pairs[index].clone();
        let mut truth = index;
        let last_whole = &pairs[self.first - 1];
        let ago = |lag: isize| &pairs[index.saturating_add_signed(-lag).min(pairs.len() - 1)];
        match self.kind {
            Corruption::None => {}
            Corruption::Blur => self.on_both(&mut pair, Self::blur),
            Corruption::Black => fill_both(&mut pair, 0),
            Corruption::BlackSide => side_of(&mut pair, self.side).pixels_mut().fill(0),
            Corruption::Saturated => fill_both(&mut pair, 255),
            Corruption::Swapped => std::mem::swap(&mut pair.left, &mut pair.right),
            Corruption::Reversed => {
                truth = self.first + self.count - 1 - (index - self.first);
                pair.clone_from(&pairs[truth]);
            }
            Corruption::Frozen => take_images(&mut pair, last_whole),
            Corruption::FrozenSide => take_side(&mut pair, last_whole, self.side),
            Corruption::Stale => {
                take_images(&mut pair, &pairs[self.first - 1 - self.lag.unsigned_abs()])
            }
            Corruption::LateSide => {
                let other = ago(self.lag);
                take_side(&mut pair, other, self.side);
                self.renew(&mut pair);
            }
            Corruption::LateBoth => {
                take_images(&mut pair, ago(self.lag));
                self.renew(&mut pair);
                truth = index - self.lag.unsigned_abs();
            }
            Corruption::Noise => {
                let sigma = 10.0 + 50.0 * self.strength;
                self.on_both(&mut pair, |s, image| s.noise(image, sigma));
            }
            Corruption::HalfOld | Corruption::HalfLate => {
                let old = if self.kind == Corruption::HalfOld {
                    last_whole
                } else {
                    truth -= usize::from(self.cut < 0.5);
                    &pairs[index - 1]
                };
                self.lower_part(&mut pair.left, |row| old.left.row(row));
                self.lower_part(&mut pair.right, |row| old.right.row(row));
            }
            Corruption::HalfOldSide => {
                let old = match self.side {
                    Side::Left => &last_whole.left,
                    Side::Right => &last_whole.right,
                };
                self.lower_part(side_of(&mut pair, self.side), |row| old.row(row));
            }
            Corruption::HalfBlack => {
                let black = vec![0; pair.left.width() as usize];
                self.lower_part(&mut pair.left, |_| &black);
                self.lower_part(&mut pair.right, |_| &black);
            }
            Corruption::Torn => {
                let by = 3 + (40.0 * self.strength) as usize;
                let cut = self.cut;
                let image = side_of(&mut pair, self.side);
                let width = image.width() as usize;
                let from = (cut * f64::from(image.height())) as usize;
                for row in image.pixels_mut().chunks_exact_mut(width).skip(from) {
                    row.rotate_right(by);
                }
            }
            Corruption::Bands => self.on_both(&mut pair, Self::bands),
            Corruption::Mover | Corruption::Cover => {
                self.cover(&mut pair, index);
                self.renew(&mut pair);
            }
            Corruption::Exposure => self.on_both(&mut pair, Self::expose),
            Corruption::ExposureSide => {
                let side = self.side;
                self.expose(side_of(&mut pair, side));
            }
            Corruption::Smear => {
                let side = self.side;
                self.smear(side_of(&mut pair, side));
            }
            Corruption::Displaced => {
                let px = 1.0 + 5.0 * self.strength;
                let by =
                    [px * self.direction_rad.cos(), px * self.direction_rad.sin()].map(f64::round);
                displace(side_of(&mut pair, self.side), by);
            }
            Corruption::OtherPlace => {
                take_images(&mut pair, self.material.other_place);
                self.renew(&mut pair);
                truth = self.first;
            }
            Corruption::OtherPlaceSide => {
                take_side(&mut pair, self.material.other_place, self.side);
                self.renew(&mut pair);
            }
            Corruption::OverExposed => {
                let gain = 4.0 + 4.0 * self.strength;
                self.on_both(&mut pair, |_, image| multiply(image, gain));
            }
        }
        Spoilt { pair, truth }
    }

    fn on_both(&mut self, pair: &mut StereoPair, mut work: impl FnMut(&mut Self, &mut GrayImage)) {
        work(self, &mut pair.left);
        work(self, &mut pair.right);
    }

    /// Noise too weak to matter, so that no image is handed on twice to the byte.
    fn renew(&mut self, pair: &mut StereoPair) {
        self.on_both(pair, |s, image| s.noise(image, 0.5));
    }

    fn noise(&mut self, image: &mut GrayImage, sigma: f64) {
        for value in image.pixels_mut() {
            let normal: f64 = self.rng.sample(StandardNormal);
            *value = grey(f64::from(*value) + sigma * normal);
        }
    }

    fn blur(&mut self, image: &mut GrayImage) {
        let length_px = 4.0 + 20.0 * self.strength;
        let (sin, cos) = self.direction_rad.sin_cos();
        let steps = length_px.ceil() as i32;
        let from = image.clone();
        let (width, height) = (from.width() as i32, from.height() as i32);
        let offsets: Vec<[i32; 2]> = (0..=steps)
            .map(|i| length_px * (f64::from(i) / f64::from(steps) - 0.5))
            .map(|along| [(along * cos).round() as i32, (along * sin).round() as i32])
            .collect();
        for (i, value) in image.pixels_mut().iter_mut().enumerate() {
            let (x, y) = (i as i32 % width, i as i32 / width);
            let sum: u32 = offsets
                .iter()
                .map(|[dx, dy]| {
                    let (x, y) = ((x + dx).clamp(0, width - 1), (y + dy).clamp(0, height - 1));
                    u32::from(from.pixels()[(y * width + x) as usize])
                })
                .sum();
            *value = (sum / offsets.len() as u32) as u8;
        }
    }

    fn lower_part<'r>(&self, image: &mut GrayImage, row: impl Fn(u32) -> &'r [u8]) {
        let from = (self.cut * f64::from(image.height())) as u32;
        let width = image.width() as usize;
        for y in from..image.height() {
            image.pixels_mut()[y as usize * width..][..width].copy_from_slice(row(y));
        }
    }

    fn bands(&mut self, image: &mut GrayImage) {
        const ROWS: usize = 8;
        let (width, height) = (image.width() as usize, image.height() as usize);
        for _ in 0..3 + (6.0 * self.strength) as usize {
            let from = self.rng.random_range(0..height - ROWS);
            image.pixels_mut()[from * width..(from + ROWS) * width].fill(0);
        }
    }

    /// A rectangle over a third of the image, nearer than the rest: blank, or with texture that moves.
    fn cover(&self, pair: &mut StereoPair, index: usize) {
        let (width, height) = (pair.left.width() as usize, pair.left.height() as usize);
        let step = (index - self.first) as f64;
        let moved_px = step * (3.0 + 12.0 * self.strength);
        let (sin, cos) = self.direction_rad.sin_cos();
        let disparity_px = 8.0 + 20.0 * self.strength;
        let (wide, high) = (
            (0.6 * width as f64) as usize,
            (0.56 * height as f64) as usize,
        );
        let left = 0.3 * width as f64 + moved_px * cos;
        let top = (0.2 * height as f64 + moved_px * sin).max(0.0) as usize;
        for (image, x) in [
            (&mut pair.left, left),
            (&mut pair.right, left - disparity_px),
        ] {
            let x = x.max(0.0) as usize;
            for y in top..(top + high).min(height) {
                for column in x..(x + wide).min(width) {
                    let value = match self.kind {
                        Corruption::Mover => self.texture.row((y - top) as u32)[column - x],
                        _ => 20,
                    };
                    image.pixels_mut()[y * width + column] = value;
                }
            }
        }
    }

    fn expose(&mut self, image: &mut GrayImage) {
        let gain = if self.direction_rad < 3.0 {
            0.15 + 0.5 * self.strength
        } else {
            1.5 + 2.0 * self.strength
        };
        multiply(image, gain);
    }

    /// A round blot in which the image is out of focus and pale.
    fn smear(&mut self, image: &mut GrayImage) {
        const REACH: i32 = 5;
        let from = image.clone();
        let (width, height) = (from.width() as i32, from.height() as i32);
        let centre = [
            self.cut * f64::from(width),
            (1.0 - self.cut) * f64::from(height),
        ];
        let radius = (0.15 + 0.25 * self.strength) * f64::from(width);
        for (i, value) in image.pixels_mut().iter_mut().enumerate() {
            let (x, y) = (i as i32 % width, i as i32 / width);
            if (f64::from(x) - centre[0]).hypot(f64::from(y) - centre[1]) > radius {
                continue;
            }
            let mut sum = 0;
            for dy in -REACH..=REACH {
                for dx in -REACH..=REACH {
                    let (x, y) = ((x + dx).clamp(0, width - 1), (y + dy).clamp(0, height - 1));
                    sum += u32::from(from.pixels()[(y * width + x) as usize]);
                }
            }
            let mean = f64::from(sum) / f64::from((2 * REACH + 1) * (2 * REACH + 1));
            *value = grey(0.6 * mean + 60.0);
        }
    }
}

fn side_of(pair: &mut StereoPair, side: Side) -> &mut GrayImage {
    match side {
        Side::Left => &mut pair.left,
        Side::Right => &mut pair.right,
    }
}

fn fill_both(pair: &mut StereoPair, value: u8) {
    pair.left.pixels_mut().fill(value);
    pair.right.pixels_mut().fill(value);
}

/// Takes the images of another pair; the stamp stays.
fn take_images(pair: &mut StereoPair, other: &StereoPair) {
    pair.left.clone_from(&other.left);
    pair.right.clone_from(&other.right);
}

/// Takes one image of another pair.
fn take_side(pair: &mut StereoPair, other: &StereoPair, side: Side) {
    match side {
        Side::Left => pair.left.clone_from(&other.left),
        Side::Right => pair.right.clone_from(&other.right),
    }
}

fn multiply(image: &mut GrayImage, gain: f64) {
    for value in image.pixels_mut() {
        *value = grey(gain * f64::from(*value));
    }
}

fn displace(image: &mut GrayImage, [dx, dy]: [f64; 2]) {
    let from = image.clone();
    let (width, height) = (from.width() as i32, from.height() as i32);
    for (i, value) in image.pixels_mut().iter_mut().enumerate() {
        let x = (i as i32 % width - dx as i32).clamp(0, width - 1);
        let y = (i as i32 / width - dy as i32).clamp(0, height - 1);
        *value = from.pixels()[(y * width + x) as usize];
    }
}

/// Texture in which features are found: random squares of several sizes.
fn blotches(width: u32, height: u32, rng: &mut Xoshiro256PlusPlus) -> GrayImage {
    let mut image = GrayImage::filled(width, height, 120);
    let (width, height) = (width as usize, height as usize);
    for _ in 0..1500 {
        let size = rng.random_range(3..20);
        let (x, y) = (rng.random_range(0..width), rng.random_range(0..height));
        let value = rng.random();
        for row in y..(y + size).min(height) {
            image.pixels_mut()[row * width + x..row * width + (x + size).min(width)].fill(value);
        }
    }
    image
}

fn grey(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}
