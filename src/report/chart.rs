//! Charts as inline SVG.
use std::fmt::Write;

const WIDTH: f64 = 400.0;
const HEIGHT: f64 = 200.0;
const LEFT: f64 = 44.0;
const BOTTOM: f64 = 30.0;

/// Step of 1, 2 or 5 times a power of ten that divides `span` into at most `most` parts.
fn nice_step(span: f64, most: f64) -> f64 {
    let raw = (span / most).max(1e-9);
    let power = 10f64.powf(raw.log10().floor());
    let factor = [1.0, 2.0, 5.0, 10.0].into_iter().find(|f| f * power >= raw * 0.999).unwrap_or(10.0);
    factor * power
}

/// Chart of a curve (x, y) with axis labels; empty without at least two finite points.
pub fn line_chart(points: &[(f64, f64)], x_label: &str, y_label: &str) -> String {
    let points: Vec<_> = points.iter().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    if points.len() < 2 {
        return String::new();
    }
    let range = |get: fn(&(f64, f64)) -> f64| {
        points.iter().fold((f64::MAX, f64::MIN), |(a, b), p| (a.min(get(p)), b.max(get(p))))
    };
    let ((x0, x1), (low, high)) = (range(|p| p.0), range(|p| p.1));
    let step = nice_step((high - low).max(1e-6), 5.0);
    let (y0, y1) = ((low / step).floor() * step, (high / step).ceil() * step + 1e-9);
    let px = |x: f64| LEFT + (x - x0) / (x1 - x0).max(1e-9) * (WIDTH - LEFT - 12.0);
    let py = |y: f64| HEIGHT - BOTTOM - (y - y0) / (y1 - y0) * (HEIGHT - BOTTOM - 12.0);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{y_label} over {x_label}\">"
    );
    // Writing to a String cannot fail.
    for k in 0..=((y1 - y0) / step).round() as usize {
        let y = y0 + k as f64 * step;
        let decimals = (-step.log10().floor()).clamp(0.0, 3.0) as usize;
        let _ = write!(svg, "<path class=\"grid\" d=\"M{LEFT} {:.1}H{WIDTH}\"/>", py(y));
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{y:.decimals$}</text>",
            LEFT - 6.0,
            py(y) + 4.0
        );
    }
    let x_step = nice_step(x1 - x0, 6.0);
    for k in (x0 / x_step).ceil() as i64..=(x1 / x_step).floor() as i64 {
        let x = k as f64 * x_step;
        let _ =
            write!(svg, "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\">{x}</text>", px(x), HEIGHT - 12.0);
    }
    let path: Vec<String> = points.iter().map(|p| format!("{:.1} {:.1}", px(p.0), py(p.1))).collect();
    let _ = write!(svg, "<path class=\"line\" d=\"M{}\"/>", path.join("L"));
    let _ = write!(
        svg,
        "<text x=\"{LEFT}\" y=\"10\">{y_label}</text><text x=\"{WIDTH}\" y=\"{}\" text-anchor=\"end\">{x_label}</text></svg>",
        HEIGHT - 1.0
    );
    svg
}

/// One bar of [`bar_chart`].
#[derive(Clone, Debug)]
pub struct Bar {
    /// Name above the bars of a group.
    pub group: String,
    /// Label left of the bar.
    pub label: String,
    /// Value in [0, 1].
    pub value: f64,
    /// Standard deviation, drawn to both sides of the end of the bar.
    pub error: Option<f64>,
    /// Value of a tick to compare with.
    pub reference: Option<f64>,
}

/// Chart of horizontal bars of values in [0, 1], as a complete SVG file; empty without bars.
pub fn bar_chart(bars: &[Bar], title: &str) -> String {
    const ROW: f64 = 22.0;
    const BAR_LEFT: f64 = 210.0;
    if bars.is_empty() {
        return String::new();
    }
    let px = |v: f64| BAR_LEFT + v.clamp(0.0, 1.0) * (WIDTH - BAR_LEFT - 56.0);
    let mut body = String::new();
    let mut y = 30.0;
    let mut group = "";
    for bar in bars {
        if bar.group != group {
            group = &bar.group;
            // Writing to a String cannot fail.
            let _ = write!(
                body,
                "<text x=\"8\" y=\"{:.1}\" font-weight=\"bold\">{}</text>",
                y + 15.0,
                escape(group)
            );
            y += ROW;
        }
        let text = y + 15.0;
        let _ = write!(
            body,
            "<text x=\"{}\" y=\"{text:.1}\" text-anchor=\"end\">{}</text><rect x=\"{BAR_LEFT}\" y=\"{:.1}\" \
             width=\"{:.1}\" height=\"{:.1}\" fill=\"#3b7dd8\"/><text x=\"{:.1}\" y=\"{text:.1}\">{:.3}</text>",
            BAR_LEFT - 8.0,
            escape(&bar.label),
            y + 3.0,
            px(bar.value) - BAR_LEFT,
            ROW - 6.0,
            px(bar.value + bar.error.unwrap_or(0.0)) + 6.0,
            bar.value
        );
        if let Some(error) = bar.error {
            let (low, high) = (px(bar.value - error), px(bar.value + error));
            let _ = write!(
                body,
                "<path d=\"M{low:.1} {0:.1}H{high:.1}M{low:.1} {1:.1}v8M{high:.1} {1:.1}v8\" stroke=\"#222\"/>",
                y + ROW / 2.0,
                y + ROW / 2.0 - 4.0
            );
        }
        if let Some(r) = bar.reference {
            let _ = write!(
                body,
                "<path d=\"M{:.1} {:.1}v{:.1}\" stroke=\"#c0392b\" stroke-width=\"3\"/>",
                px(r),
                y + 1.0,
                ROW - 2.0
            );
        }
        y += ROW;
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {:.0}\" font-family=\"sans-serif\" \
         font-size=\"13\"><rect width=\"100%\" height=\"100%\" fill=\"white\"/><text x=\"8\" y=\"18\" \
         font-size=\"14\">{}</text>{body}</svg>\n",
        y + 8.0,
        escape(title)
    )
}

/// Escapes a text for HTML and SVG.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_chart_stays_inside_its_axes() {
        let svg = line_chart(&[(0.0, 12.5), (100.0, 20.0), (f64::NAN, 1.0), (300.0, 31.5)], "step", "dB");
        let d = svg.split("class=\"line\" d=\"M").nth(1).unwrap().split('"').next().unwrap();
        let xy: Vec<Vec<f64>> =
            d.split('L').map(|p| p.split(' ').map(|v| v.parse().unwrap()).collect()).collect();
        assert_eq!((xy.len(), xy[0][0], xy[2][0]), (3, LEFT, WIDTH - 12.0));
        assert!(xy.iter().all(|p| p[1] >= 0.0 && p[1] <= HEIGHT - BOTTOM) && xy[0][1] > xy[2][1]);
        assert_eq!(line_chart(&[(1.0, 2.0)], "a", "b"), "");
        assert!(line_chart(&[(0.0, 5.0), (1.0, 5.0)], "a", "b").contains("class=\"line\""), "a flat curve");
    }

    #[test]
    fn nice_step_is_round() {
        assert_eq!([nice_step(10.0, 5.0), nice_step(19.0, 5.0), nice_step(1000.0, 6.0)], [2.0, 5.0, 200.0]);
    }

    #[test]
    fn bar_chart_lengths_match_values() {
        let bar = |label: &str, value, error, reference| Bar {
            group: "g".into(),
            label: label.into(),
            value,
            error,
            reference,
        };
        let svg = bar_chart(&[bar("a<b", 0.5, Some(0.25), None), bar("c", 1.0, None, Some(0.25))], "t");
        let widths: Vec<f64> = svg
            .split("width=\"")
            .filter(|s| s.contains("fill=\"#3b7dd8\""))
            .filter_map(|s| s.split('"').next()?.parse().ok())
            .collect();
        assert_eq!(widths.len(), 2);
        assert!(
            (widths[1] / widths[0] - 2.0).abs() < 0.01 && svg.contains("a&lt;b") && svg.contains("stroke")
        );
        // The bar of value 1 has the full width; the error line is symmetric about the end of its
        // bar.
        let line = svg.split("<path d=\"M").find(|p| p.contains("#222")).unwrap();
        let ends: Vec<f64> = line.split(['M', 'H', ' ', 'v']).filter_map(|v| v.parse().ok()).collect();
        assert!((ends[2] - ends[0] - 0.5 * widths[1]).abs() < 0.2, "{ends:?} {widths:?}");
        assert_eq!(svg.matches("#222").count(), 1);
        assert_eq!(bar_chart(&[], "t"), "");
    }
}
