//! Numbers and words in, SVG text out: what is not a number never gets there.

use std::fmt::Write as _;

/// Text as it may stand in HTML and SVG, attributes included.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // XML knows no control characters but white space.
            c if c.is_control() && !c.is_whitespace() => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// A coordinate, px, to a tenth; far outside the drawing it stays at a distance that viewers bear.
pub(crate) fn px(value: f64) -> String {
    let text = format!("{:.1}", value.clamp(-1e5, 1e5));
    match text.strip_suffix(".0") {
        Some("-0") => "0".to_owned(),
        Some(whole) => whole.to_owned(),
        None => text,
    }
}

/// The `d` of a path under construction. A point that is not finite lifts the pen.
#[derive(Default)]
pub(crate) struct PathData {
    d: String,
    drawing: bool,
    last: Option<(String, String)>,
}

impl PathData {
    /// Draws on to a point, px.
    pub(crate) fn to(&mut self, x: f64, y: f64) {
        if !(x.is_finite() && y.is_finite()) {
            self.lift();
            return;
        }
        let point = (px(x), px(y));
        if self.drawing && self.last.as_ref() == Some(&point) {
            return;
        }
        let command = if self.drawing { 'L' } else { 'M' };
        // Writing to a `String` cannot fail.
        let _ = write!(self.d, "{command}{},{}", point.0, point.1);
        if !self.drawing {
            // With round caps, a line to the same place shows a point that stands alone.
            self.d.push_str("h0");
        }
        self.drawing = true;
        self.last = Some(point);
    }

    /// Begins a new line with the next point.
    pub(crate) fn lift(&mut self) {
        self.drawing = false;
    }

    /// Closes the outline drawn so far.
    pub(crate) fn close(&mut self) {
        if self.drawing {
            self.d.push('Z');
        }
        self.drawing = false;
    }

    /// The element; nothing if nothing was drawn.
    pub(crate) fn element(&self, class: &str) -> String {
        if self.d.is_empty() {
            return String::new();
        }
        format!("<path class=\"{class}\" d=\"{}\"/>\n", self.d)
    }
}

/// A straight line, px.
pub(crate) fn line(from: (f64, f64), to: (f64, f64), class: &str) -> String {
    format!(
        "<line class=\"{class}\" x1=\"{}\" y1=\"{}\" x2=\"{}\" y2=\"{}\"/>\n",
        px(from.0),
        px(from.1),
        px(to.0),
        px(to.1)
    )
}

/// A rectangle, px.
pub(crate) fn rect(left: f64, top: f64, width: f64, height: f64, class: &str) -> String {
    format!(
        "<rect class=\"{class}\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"/>\n",
        px(left),
        px(top),
        px(width.max(0.0)),
        px(height.max(0.0))
    )
}

/// A dot, px.
pub(crate) fn dot(x: f64, y: f64, radius: f64, class: &str) -> String {
    if !(x.is_finite() && y.is_finite()) {
        return String::new();
    }
    format!(
        "<circle class=\"{class}\" cx=\"{}\" cy=\"{}\" r=\"{}\"/>\n",
        px(x),
        px(y),
        px(radius)
    )
}

/// A text at a point, px; `class` says how it is anchored.
pub(crate) fn text(x: f64, y: f64, class: &str, text: &str) -> String {
    format!(
        "<text class=\"{class}\" x=\"{}\" y=\"{}\">{}</text>\n",
        px(x),
        px(y),
        escape(text)
    )
}

/// A text that reads upwards.
pub(crate) fn text_up(x: f64, y: f64, class: &str, text: &str) -> String {
    format!(
        "<text class=\"{class}\" transform=\"translate({} {}) rotate(-90)\">{}</text>\n",
        px(x),
        px(y),
        escape(text)
    )
}

/// The drawing itself; `label` is what a screen reader says of it.
pub(crate) fn drawing(width: f64, height: f64, label: &str, content: &str) -> String {
    format!(
        "<svg class=\"plot\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\">\n{content}</svg>\n",
        px(width),
        px(height),
        escape(label)
    )
}
