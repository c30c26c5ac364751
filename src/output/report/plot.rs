//! Series over one quantity in, a panel with axes, lines, bands and dots out.

use super::scale::Scale;
use super::svg::{PathData, dot, line, px, rect, text, text_up};

/// Points of a series that are drawn one by one; of more, the extremes of each stretch are.
const MOST_POINTS: usize = 6000;

/// Where on the drawing a panel's data area lies, px.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frame {
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

/// A data area with two axes, and what was drawn into it.
pub(crate) struct Panel {
    frame: Frame,
    x: Scale,
    y: Scale,
    content: String,
}

impl Panel {
    /// A linear panel over given domains.
    pub(crate) fn new(frame: Frame, x: (f64, f64), y: (f64, f64)) -> Self {
        let y = Scale::linear(y, (frame.top + frame.height, frame.top));
        Self::with_y(frame, x, y)
    }

    /// A panel whose y axis is logarithmic.
    pub(crate) fn logarithmic(frame: Frame, x: (f64, f64), y: (f64, f64)) -> Self {
        let y = Scale::logarithmic(y, (frame.top + frame.height, frame.top));
        Self::with_y(frame, x, y)
    }

    fn with_y(frame: Frame, x: (f64, f64), y: Scale) -> Self {
        let x = Scale::linear(x, (frame.left, frame.left + frame.width));
        Self::with_scales(frame, x, y)
    }

    /// A panel over given scales.
    pub(crate) fn with_scales(frame: Frame, x: Scale, y: Scale) -> Self {
        Self {
            frame,
            x,
            y,
            content: String::new(),
        }
    }

    /// Puts elements into the panel.
    pub(crate) fn draw(&mut self, elements: &str) {
        self.content.push_str(elements);
    }

    /// A line through points; what is not finite leaves a gap.
    pub(crate) fn line(&mut self, points: &[(f64, f64)], class: &str) {
        let mut path = PathData::default();
        for (x, y) in thin_out(points) {
            path.to(self.x.at(x), self.inside(self.y.at(y)));
        }
        self.content.push_str(&path.element(class));
    }

    /// The area between two curves: points are x, low, high.
    pub(crate) fn band(&mut self, points: &[(f64, f64, f64)], class: &str) {
        let is_good = |p: &&(f64, f64, f64)| p.0.is_finite() && p.1.is_finite() && p.2.is_finite();
        let mut path = PathData::default();
        for run in points.split(|p| !is_good(&p)) {
            let edge = |of: fn(&(f64, f64, f64)) -> f64| -> Vec<_> {
                thin_out(&run.iter().map(|p| (p.0, of(p))).collect::<Vec<_>>())
            };
            let (low, high) = (edge(|p| p.1), edge(|p| p.2));
            for (x, y) in low.into_iter().chain(high.into_iter().rev()) {
                path.to(self.x.at(x), self.inside(self.y.at(y)));
            }
            path.close();
        }
        self.content.push_str(&path.element(class));
    }

    /// The area between two values, from end to end.
    pub(crate) fn level_band(&mut self, low: f64, high: f64, class: &str) {
        let (top, bottom) = (self.inside(self.y.at(high)), self.inside(self.y.at(low)));
        let Frame { left, width, .. } = self.frame;
        self.content
            .push_str(&rect(left, top, width, bottom - top, class));
    }

    /// A line at one value, from end to end.
    pub(crate) fn level(&mut self, y: f64, class: &str) {
        let y = self.y.at(y);
        let Frame { left, width, .. } = self.frame;
        self.content
            .push_str(&line((left, y), (left + width, y), class));
    }

    /// A dot a point.
    pub(crate) fn dots(&mut self, points: &[(f64, f64)], radius: f64, class: &str) {
        for &(x, y) in points {
            let (x, y) = (self.x.at(x), self.inside(self.y.at(y)));
            self.content.push_str(&dot(x, y, radius, class));
        }
    }

    /// A bar from one x to another over the whole height.
    pub(crate) fn span(&mut self, from: f64, to: f64, class: &str) {
        let (left, right) = (self.x.at(from), self.x.at(to));
        if left.is_finite() && right.is_finite() {
            let Frame { top, height, .. } = self.frame;
            let width = (right - left).max(1.0);
            self.content
                .push_str(&rect(left, top, width, height, class));
        }
    }

    /// The finished panel: grid below, content, axes with labels. Without `x_label` the panel is
    /// one of a stack and shows no numbers below.
    pub(crate) fn finish(self, y_label: &str, x_label: Option<&str>) -> String {
        let Frame {
            left,
            top,
            width,
            height,
        } = self.frame;
        let bottom = top + height;
        let mut out = rect(left, top, width, height, "ground");
        for (value, label) in self.y.ticks((height / 27.0) as usize) {
            let y = self.y.at(value);
            out.push_str(&line((left, y), (left + width, y), "grid"));
            out.push_str(&text(left - 8.0, y + 4.0, "tick end", &label));
        }
        for (value, _) in self.x.ticks((width / 90.0) as usize) {
            let x = self.x.at(value);
            out.push_str(&line((x, top), (x, bottom), "grid"));
        }
        out.push_str(&self.clipped());
        out.push_str(&rect(left, top, width, height, "frame"));
        out.push_str(&text_up(
            left - 52.0,
            top + height / 2.0,
            "label middle",
            y_label,
        ));
        if let Some(x_label) = x_label {
            out.push_str(&self.x_axis(bottom, x_label));
        }
        out
    }

    /// The finished panel without a y axis.
    pub(crate) fn finish_strip(self, x_label: &str) -> String {
        let Frame {
            left,
            top,
            width,
            height,
        } = self.frame;
        let bottom = top + height;
        let mut out = rect(left, top, width, height, "ground") + &self.clipped();
        out.push_str(&rect(left, top, width, height, "frame"));
        out.push_str(&self.x_axis(bottom, x_label));
        out
    }

    /// The content, cut off at the panel's edges, as an inner drawing is.
    fn clipped(&self) -> String {
        let Frame {
            left,
            top,
            width,
            height,
        } = self.frame;
        let [left, top, width, height] = [left, top, width, height].map(px);
        format!(
            "<svg x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"{left} {top} {width} {height}\">\n{}</svg>\n",
            self.content
        )
    }

    /// Numbers and label below.
    fn x_axis(&self, bottom: f64, label: &str) -> String {
        let mut out = String::new();
        for (value, tick) in self.x.ticks((self.frame.width / 90.0) as usize) {
            let x = self.x.at(value);
            out.push_str(&line((x, bottom), (x, bottom + 4.0), "notch"));
            out.push_str(&text(x, bottom + 18.0, "tick middle", &tick));
        }
        let middle = self.frame.left + self.frame.width / 2.0;
        out + &text(middle, bottom + 38.0, "label middle", label)
    }

    /// Keeps a place within the panel, so that an outlier stands at its edge.
    fn inside(&self, y: f64) -> f64 {
        let (a, b) = self.y.range();
        y.clamp(a.min(b), a.max(b))
    }
}

/// All points, or of very many the lowest and highest of each stretch in their order.
fn thin_out(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    if points.len() <= MOST_POINTS {
        return points.to_vec();
    }
    let stretch = points.len().div_ceil(MOST_POINTS / 2);
    let mut kept = Vec::with_capacity(MOST_POINTS);
    for part in points.chunks(stretch) {
        let finite = || (0..part.len()).filter(|&i| part[i].1.is_finite());
        let low = finite().min_by(|&a, &b| part[a].1.total_cmp(&part[b].1));
        let high = finite().max_by(|&a, &b| part[a].1.total_cmp(&part[b].1));
        match (low, high) {
            (Some(a), Some(b)) if a == b => kept.push(part[a]),
            (Some(a), Some(b)) => kept.extend([part[a.min(b)], part[a.max(b)]]),
            _ => kept.push(part[0]),
        }
    }
    kept
}
