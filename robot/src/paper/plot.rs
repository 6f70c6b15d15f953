//! Plots as SVG: curves, point clouds in 3D coloured by value, bars.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use teleop_common::hand::Finger;
use teleop_common::viz::{finger_rgb, heat};

/// Where one draws.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Axes<'a, 'b> = ChartContext<'b, SVGBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

pub(super) const FONT: &str = "DejaVu Sans, Verdana, sans-serif";
pub(super) const INK: RGBColor = RGBColor(40, 42, 48);
pub(super) const GREY: RGBColor = RGBColor(140, 145, 153);
pub(super) const LIGHT: RGBColor = RGBColor(224, 227, 232);

/// The finger's colour of the live picture, darkened for white paper.
pub(super) fn color(finger: Finger) -> RGBColor {
    let [r, g, b] = finger_rgb(finger).map(|part| (f64::from(part) * 0.82) as u8);
    RGBColor(r, g, b)
}

/// An SVG of the given size, px.
pub(super) fn figure(size: (u32, u32), draw: impl FnOnce(&Area<'_>) -> anyhow::Result<()>) -> anyhow::Result<String> {
    let mut text = String::new();
    let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
    root.fill(&WHITE)?;
    draw(&root)?;
    root.present()?;
    drop(root);
    Ok(text)
}

pub(super) fn text(area: &Area<'_>, at: (i32, i32), size: u32, anchor: HPos, what: &str) -> anyhow::Result<()> {
    let style = (FONT, size).into_font().color(&INK).pos(Pos::new(anchor, VPos::Center));
    Ok(area.draw(&Text::new(what.to_owned(), at, style))?)
}

/// One curve; points that are no number are left out.
pub(super) struct Curve {
    pub(super) points: Vec<(f64, f64)>,
    pub(super) color: RGBColor,
    pub(super) stroke: Stroke,
}

#[derive(Clone, Copy)]
pub(super) enum Stroke {
    Solid,
    Bold,
    Dashed,
}

/// A plot of curves over a common axis.
pub(super) struct Panel<'a> {
    pub(super) title: &'a str,
    pub(super) x: (&'a str, Range<f64>),
    pub(super) y: (&'a str, Option<Range<f64>>),
    pub(super) curves: Vec<Curve>,
    /// Shaded stretches of the x axis.
    pub(super) bands: Vec<(f64, f64)>,
}

/// A number of an axis, without idle digits.
fn plain(value: &f64) -> String {
    format!("{}", (value * 1e6).round() / 1e6 + 0.0)
}

impl Panel<'_> {
    pub(super) fn draw(&self, area: &Area<'_>) -> anyhow::Result<()> {
        let x = self.x.1.clone();
        let inside = |&&(at, value): &&(f64, f64)| value.is_finite() && at >= x.start && at <= x.end;
        let y = self.y.1.clone().unwrap_or_else(|| {
            let values = self.curves.iter().flat_map(|curve| curve.points.iter().filter(inside).map(|point| point.1));
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
                (f64::min(low, value), f64::max(high, value))
            });
            let pad = ((high - low) * 0.07).max(1e-3);
            if low.is_finite() { low - pad..high + pad } else { 0.0..1.0 }
        });
        let mut builder = ChartBuilder::on(area);
        builder.margin(6).margin_right(14).x_label_area_size(34).y_label_area_size(56);
        if !self.title.is_empty() {
            builder.caption(self.title, (FONT, 15).into_font().color(&INK));
        }
        let mut axes: Axes<'_, '_> = builder.build_cartesian_2d(x.clone(), y)?;
        axes.configure_mesh()
            .x_desc(self.x.0)
            .y_desc(self.y.0)
            .axis_desc_style((FONT, 13).into_font().color(&INK))
            .label_style((FONT, 12).into_font().color(&INK))
            .axis_style(GREY)
            .bold_line_style(LIGHT)
            .light_line_style(TRANSPARENT)
            .x_labels(9)
            .y_labels(6)
            .x_label_formatter(&plain)
            .y_label_formatter(&plain)
            .draw()?;
        let (low, high) = (axes.y_range().start, axes.y_range().end);
        for (from, to) in &self.bands {
            axes.draw_series([Rectangle::new([(*from, low), (*to, high)], RGBColor(244, 240, 226).filled())])?;
        }
        for curve in &self.curves {
            let points = || curve.points.iter().filter(inside).copied();
            let style = |width: u32| curve.color.stroke_width(width);
            match curve.stroke {
                Stroke::Solid => axes.draw_series(LineSeries::new(points(), style(2)))?,
                Stroke::Bold => axes.draw_series(LineSeries::new(points(), style(4)))?,
                Stroke::Dashed => {
                    let points: Vec<_> = points().collect();
                    axes.draw_series(DashedLineSeries::new(points, 7, 5, style(2)))?
                }
            };
        }
        Ok(())
    }
}

/// A row of names with samples of their lines, from `at` to the right.
pub(super) fn legend(area: &Area<'_>, at: (i32, i32), entries: &[(&str, RGBColor, Stroke)]) -> anyhow::Result<()> {
    let (mut x, y) = at;
    for (name, color, stroke) in entries {
        let sample = |from: i32, to: i32, width: u32| {
            area.draw(&PathElement::new([(x + from, y), (x + to, y)], color.stroke_width(width)))
        };
        match stroke {
            Stroke::Solid => sample(0, 26, 2)?,
            Stroke::Bold => sample(0, 26, 4)?,
            Stroke::Dashed => (0..3).try_for_each(|dash| sample(dash * 10, dash * 10 + 6, 2))?,
        }
        text(area, (x + 32, y), 14, HPos::Left, name)?;
        x += 32 + width(name, 14) + 24;
    }
    Ok(())
}

/// About how wide a text is, px.
pub(super) fn width(text: &str, size: i32) -> i32 {
    text.chars().count() as i32 * size * 60 / 100
}

/// Colours for values.
#[derive(Clone, Copy)]
pub(super) enum Scale {
    /// From 0 upwards.
    Magnitude,
    /// Blue below 0, red above.
    Signed,
}

impl Scale {
    fn color(self, value: f64, range: &Range<f64>) -> RGBColor {
        let u = ((value - range.start) / (range.end - range.start)).clamp(0.0, 1.0);
        match self {
            Self::Magnitude => {
                let [r, g, b] = heat(u);
                RGBColor(r, g, b)
            }
            Self::Signed => {
                let ends = [[33, 80, 175], [236, 236, 236], [185, 30, 45]];
                let (from, to, share) =
                    if u < 0.5 { (ends[0], ends[1], u * 2.0) } else { (ends[1], ends[2], u * 2.0 - 1.0) };
                let mix = |i: usize| (f64::from(from[i]) * (1.0 - share) + f64::from(to[i]) * share) as u8;
                RGBColor(mix(0), mix(1), mix(2))
            }
        }
    }
}

/// Points in the cube of three phalanx lengths (mm), coloured by a value.
pub(super) struct Cloud<'a> {
    pub(super) title: String,
    pub(super) unit: &'a str,
    pub(super) scale: Scale,
    pub(super) range: Range<f64>,
    pub(super) points: Vec<([f64; 3], f64)>,
    /// Where the value of largest and of smallest magnitude are.
    pub(super) max_at: [f64; 3],
    pub(super) min_at: [f64; 3],
}

impl Cloud<'_> {
    pub(super) fn draw(&self, area: &Area<'_>) -> anyhow::Result<()> {
        let (width, height) = area.dim_in_pixel();
        let (width, height) = (f64::from(width), f64::from(height));
        text(area, ((width / 2.0) as i32, 16), 15, HPos::Center, &self.title)?;
        // A parallel projection, the third length upwards; the unit cube of 5 to 55 mm.
        let (sin, cos) = 38.0_f64.to_radians().sin_cos();
        let lift = 0.33;
        let size = ((width - 120.0) / (sin + cos)).min((height - 96.0) / (0.86 + lift * (sin + cos)));
        let centre = ((width - 70.0) / 2.0, height / 2.0 + 4.0);
        let unit = |at: [f64; 3]| at.map(|length| (length - 5.0) / 50.0 - 0.5);
        let place = |at: [f64; 3]| {
            let [a, b, c] = unit(at);
            let x = (a * cos - b * sin) * size;
            let y = (a * sin + b * cos) * lift * size - c * 0.86 * size;
            ((centre.0 + x) as i32, (centre.1 + y) as i32)
        };
        let line = |from: [f64; 3], to: [f64; 3], color: RGBColor| {
            area.draw(&PathElement::new([place(from), place(to)], color.stroke_width(1)))
        };
        // The three far faces with a grid, ticks on the near edges.
        for mark in [10.0, 20.0, 30.0, 40.0, 50.0, 55.0] {
            for (from, to) in [
                ([mark, 5.0, 5.0], [mark, 55.0, 5.0]),
                ([5.0, mark, 5.0], [55.0, mark, 5.0]),
                ([mark, 5.0, 5.0], [mark, 5.0, 55.0]),
                ([5.0, mark, 5.0], [5.0, mark, 55.0]),
                ([5.0, 5.0, mark], [55.0, 5.0, mark]),
                ([5.0, 5.0, mark], [5.0, 55.0, mark]),
            ] {
                line(from, to, LIGHT)?;
            }
            if mark > 50.0 {
                break;
            }
            let label = format!("{mark:.0}");
            let (x, y) = place([mark, 55.0, 5.0]);
            text(area, (x + 2, y + 11), 11, HPos::Center, &label)?;
            let (x, y) = place([55.0, mark, 5.0]);
            text(area, (x + 5, y + 9), 11, HPos::Left, &label)?;
            let (x, y) = place([5.0, 55.0, mark]);
            text(area, (x - 6, y), 11, HPos::Right, &label)?;
        }
        for (from, to) in [
            ([5.0, 55.0, 5.0], [55.0, 55.0, 5.0]),
            ([55.0, 5.0, 5.0], [55.0, 55.0, 5.0]),
            ([5.0, 55.0, 5.0], [5.0, 55.0, 55.0]),
        ] {
            line(from, to, GREY)?;
        }
        let (x, y) = place([30.0, 55.0, 5.0]);
        text(area, (x - 12, y + 30), 13, HPos::Center, "a1 [mm]")?;
        let (x, y) = place([55.0, 30.0, 5.0]);
        text(area, (x + 26, y + 22), 13, HPos::Left, "a2 [mm]")?;
        let (x, y) = place([5.0, 55.0, 55.0]);
        text(area, (x + 12, y - 14), 13, HPos::Center, "a3 [mm]")?;

        let mut points: Vec<_> = self.points.iter().collect();
        // Far ones first: near is large a1, a2, and a3 seen from above.
        let depth = |at: &[f64; 3]| at[0] * sin + at[1] * cos + at[2] * lift;
        points.sort_by(|a, b| depth(&a.0).total_cmp(&depth(&b.0)));
        for (at, value) in points {
            let fill = self.scale.color(*value, &self.range);
            area.draw(&Circle::new(place(*at), 5, fill.filled()))?;
            area.draw(&Circle::new(place(*at), 5, WHITE.mix(0.6).stroke_width(1)))?;
        }
        // On top of all, for they may lie inside.
        let (x, y) = place(self.min_at);
        area.draw(&Rectangle::new([(x - 8, y - 8), (x + 8, y + 8)], BLACK.stroke_width(2)))?;
        area.draw(&Circle::new(place(self.max_at), 9, BLACK.stroke_width(2)))?;
        self.bar(area, width as i32 - 58, height as i32)
    }

    /// The scale of colours.
    fn bar(&self, area: &Area<'_>, left: i32, height: i32) -> anyhow::Result<()> {
        let (top, bottom) = (64, height - 50);
        let value = |y: i32| {
            let u = f64::from(bottom - y) / f64::from(bottom - top);
            self.range.start + (self.range.end - self.range.start) * u
        };
        for y in (top..bottom).step_by(2) {
            let fill = self.scale.color(value(y), &self.range);
            area.draw(&Rectangle::new([(left, y), (left + 12, y + 2)], fill.filled()))?;
        }
        let span = self.range.end - self.range.start;
        let step = if span > 100.0 { 20.0 } else { 10.0 };
        for multiple in (self.range.start / step).ceil() as i32..=(self.range.end / step).floor() as i32 {
            let mark = f64::from(multiple) * step;
            let y = bottom - (f64::from(bottom - top) * (mark - self.range.start) / span).round() as i32;
            text(area, (left + 16, y), 11, HPos::Left, &format!("{mark:.0}"))?;
        }
        text(area, (left + 6, top - 16), 13, HPos::Center, self.unit)
    }
}

/// A power of ten as one.
fn power(value: f64) -> String {
    let exponent = value.log10().round();
    if (0.01..=1000.0).contains(&value) {
        return plain(&value);
    }
    let digits = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    format!("10{}", digits.get(exponent as usize).copied().unwrap_or('?'))
}

/// Groups of bars over a logarithmic axis.
pub(super) struct Bars<'a> {
    pub(super) title: &'a str,
    pub(super) unit: &'a str,
    pub(super) groups: Vec<(String, Vec<f64>)>,
    pub(super) colors: &'a [RGBColor],
    /// A line across, with its name.
    pub(super) limit: Option<(f64, &'a str)>,
}

impl Bars<'_> {
    pub(super) fn draw(&self, area: &Area<'_>) -> anyhow::Result<()> {
        let values = || self.groups.iter().flat_map(|(_, values)| values.iter().copied());
        let decade = |value: f64| 10_f64.powf(value);
        // A little below the power of ten, or its label is left out.
        let low = decade(values().fold(f64::INFINITY, f64::min).max(1e-6).log10().floor()) * 0.9999;
        let high = decade((values().fold(low, f64::max) * 1.2).log10().ceil());
        let count = self.groups.len() as f64;
        let mut axes = ChartBuilder::on(area)
            .margin(8)
            .margin_right(16)
            .x_label_area_size(30)
            .y_label_area_size(62)
            .caption(self.title, (FONT, 15).into_font().color(&INK))
            .build_cartesian_2d(0.0..count, (low..high).log_scale())?;
        axes.configure_mesh()
            .disable_x_mesh()
            .disable_x_axis()
            .y_desc(self.unit)
            .axis_desc_style((FONT, 13).into_font().color(&INK))
            .label_style((FONT, 12).into_font().color(&INK))
            .bold_line_style(LIGHT)
            .light_line_style(TRANSPARENT)
            .y_label_formatter(&|value| power(*value))
            .draw()?;
        axes.draw_series([PathElement::new([(0.0, low), (count, low)], GREY.stroke_width(1))])?;
        for (group, (name, values)) in self.groups.iter().enumerate() {
            let width = 0.8 / values.len() as f64;
            for (bar, (value, color)) in values.iter().zip(self.colors).enumerate() {
                let left = group as f64 + 0.1 + bar as f64 * width;
                let shape = [(left, low), (left + width * 0.92, value.max(low))];
                axes.draw_series([Rectangle::new(shape, color.filled())])?;
            }
            let (x, y) = axes.backend_coord(&(group as f64 + 0.5, low));
            let (base_x, base_y) = area.get_base_pixel();
            text(area, (x - base_x, y - base_y + 14), 12, HPos::Center, name)?;
        }
        if let Some((limit, name)) = self.limit {
            axes.draw_series([PathElement::new([(0.0, limit), (count, limit)], RED.stroke_width(1))])?;
            let (x, y) = axes.backend_coord(&(count, limit));
            let (base_x, base_y) = area.get_base_pixel();
            text(area, (x - base_x - 4, y - base_y - 9), 12, HPos::Right, name)?;
        }
        Ok(())
    }
}
