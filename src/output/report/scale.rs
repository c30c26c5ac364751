//! Values in, places on an axis and its ticks out.

/// Maps values to px, linearly or by their logarithm.
#[derive(Clone, Debug)]
pub(crate) struct Scale {
    /// Values at the ends; of a logarithmic scale both positive.
    domain: (f64, f64),
    /// Places of these, px.
    range: (f64, f64),
    logarithmic: bool,
}

impl Scale {
    /// Linear from `domain` to `range`; a domain without extent is given some.
    pub(crate) fn linear(domain: (f64, f64), range: (f64, f64)) -> Self {
        let (mut low, mut high) = match domain.0.is_finite() && domain.1.is_finite() {
            true => domain,
            false => (0.0, 1.0),
        };
        let least = 1e-9 * low.abs().max(high.abs()).max(1e-3);
        if high - low < least {
            let margin = (0.05 * low.abs()).max(least);
            (low, high) = (low - margin, high + margin);
        }
        Self {
            domain: (low, high),
            range,
            logarithmic: false,
        }
    }

    /// Logarithmic, both ends of `domain` positive.
    pub(crate) fn logarithmic(domain: (f64, f64), range: (f64, f64)) -> Self {
        let low = domain.0.max(1e-12);
        Self {
            domain: (low, domain.1.max(10.0 * low)),
            range,
            logarithmic: true,
        }
    }

    /// The place of a value, px; not a number where the value has none.
    pub(crate) fn at(&self, value: f64) -> f64 {
        let (low, high) = self.domain;
        let share = if self.logarithmic {
            (value / low).ln() / (high / low).ln()
        } else {
            (value - low) / (high - low)
        };
        self.range.0 + share * (self.range.1 - self.range.0)
    }

    /// The places at the ends, px.
    pub(crate) fn range(&self) -> (f64, f64) {
        self.range
    }

    /// About `count` round values with what to write beside them.
    pub(crate) fn ticks(&self, count: usize) -> Vec<(f64, String)> {
        if self.logarithmic {
            return self.decades();
        }
        let (low, high) = self.domain;
        let step = round_step((high - low) / count.max(1) as f64);
        let decimals = (-step.log10().floor()).clamp(0.0, 9.0) as usize;
        let (first, last) = ((low / step).ceil() as i64, (high / step).floor() as i64);
        (first..=last)
            .map(|i| i as f64 * step)
            .map(|value| (value, number(value, decimals)))
            .collect()
    }

    fn decades(&self) -> Vec<(f64, String)> {
        let (low, high) = self.domain;
        let (first, last) = (low.log10().ceil() as i32, high.log10().floor() as i32);
        let digits: &[u32] = if high / low < 2000.0 {
            &[1, 2, 5]
        } else {
            &[1]
        };
        (first - 1..=last)
            .flat_map(|exponent| digits.iter().map(move |digit| (exponent, *digit)))
            .map(|(exponent, digit)| {
                let value = f64::from(digit) * 10_f64.powi(exponent);
                let label = match exponent {
                    -3..=4 => number(value, (-exponent).max(0) as usize),
                    _ => format!("{digit}e{exponent}").replace('-', "−"),
                };
                (value, label)
            })
            .filter(|(value, _)| (low..=high).contains(value))
            .collect()
    }
}

/// 1, 2 or 5 times a power of ten, at least `least`.
pub(crate) fn round_step(least: f64) -> f64 {
    let power = 10_f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|digit| digit * power)
        .find(|step| *step >= least * (1.0 - 1e-9))
        .unwrap_or(10.0 * power)
}

/// A number with so many decimals, a real minus sign and no minus zero.
pub(crate) fn number(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
    match text.strip_prefix('-') {
        Some(positive) if is_zero => positive.to_owned(),
        Some(positive) => format!("−{positive}"),
        None => text,
    }
}

/// Three significant digits or so, as a person would write the number.
pub(crate) fn brief(value: f64) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    let magnitude = value.abs();
    let decimals = match magnitude {
        m if m >= 100.0 || m == 0.0 => 0,
        m if m >= 10.0 => 1,
        m if m >= 1.0 => 2,
        m => (2 - m.log10().floor() as i32).clamp(0, 9) as usize,
    };
    number(value, decimals)
}

/// A unit for values as large as `largest`: its name and how many there are in the base unit.
pub(crate) fn length_unit(largest_m: f64) -> (&'static str, f64) {
    match largest_m {
        m if m < 0.1 => ("mm", 1e3),
        m if m < 1.0 => ("cm", 1e2),
        m if m < 10_000.0 => ("m", 1.0),
        _ => ("km", 1e-3),
    }
}

/// The same of angles in rad.
pub(crate) fn angle_unit(largest_rad: f64) -> (&'static str, f64) {
    match largest_rad.to_degrees() {
        d if d < 0.5 => ("mdeg", 1e3_f64.to_degrees()),
        _ => ("deg", 1_f64.to_degrees()),
    }
}

/// The smallest and largest of finite values.
pub(crate) fn extent(values: impl IntoIterator<Item = f64>) -> Option<(f64, f64)> {
    values
        .into_iter()
        .filter(|v| v.is_finite())
        .fold(None, |so_far, v| match so_far {
            None => Some((v, v)),
            Some((low, high)) => Some((f64::min(low, v), f64::max(high, v))),
        })
}
