//! Which plots there are and what is in them.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use teleop_common::hand::{Finger, HandModel};
use teleop_common::mapping::FingerSignals;
use teleop_common::paper::fig2;
use teleop_common::paper::fig6::{self, Tap};
use teleop_common::paper::fig8::FINGERS;
use teleop_common::paper::{fig4, fig8};

use super::data::{self, MM};
use super::hands::{Skeleton, View, ruler};
use super::plot::{Area, Bars, Cloud, Curve, GREY, INK, Panel, Scale, Stroke, color, figure, legend, text};
use super::{Paper, Preset, Run, stem};

type Point = nalgebra::Vector3<f64>;

/// A plot and what to say about it.
pub(super) struct Figure {
    pub(super) file: String,
    pub(super) title: String,
    pub(super) caption: String,
    pub(super) svg: String,
}

const PRINTED: RGBColor = RGBColor(200, 40, 50);
const CARTESIAN: RGBColor = RGBColor(214, 74, 42);
const JOINT: RGBColor = RGBColor(90, 96, 106);
/// Where the picture of the master, and of the slave, is centred, m.
const MASTER_CENTRE: Point = Point::new(0.026, 0.082, 0.020);
const SLAVE_CENTRE: Point = Point::new(0.016, 0.026, 0.040);

/// All of them, in the paper's order.
pub(super) fn all(paper: &Paper) -> anyhow::Result<Vec<Figure>> {
    let mut out = vec![
        clouds(paper, 0, "fig2_shape", "Fig. 2a: what Cartesian mapping loses in shape")?,
        clouds(paper, 2, "fig2_position", "Fig. 2b: what joint mapping loses in position")?,
        gains(&paper.presets)?,
    ];
    for preset in &paper.presets {
        out.push(taps(&paper.hand, preset)?);
    }
    for preset in &paper.presets {
        for run in &preset.fig8 {
            out.push(frames(&paper.hand, preset, run)?);
            out.push(signals(&paper.hand, preset, run)?);
        }
    }
    out.push(smoothness(paper)?);
    Ok(out)
}

fn clouds(paper: &Paper, first: usize, stem: &str, title: &str) -> anyhow::Result<Figure> {
    let quantities = [data::FIG2[first], data::FIG2[first + 1]];
    let names = if first == 0 {
        ["|error of q2|", "error of the posture, norm"]
    } else {
        ["error along y (distal)", "error of the tip, norm"]
    };
    let svg = figure((1380, 920), |root| {
        let (head, body) = root.split_vertically(34);
        let legend = "circle: largest magnitude, square: smallest";
        text(&head, (690, 18), 14, HPos::Center, &format!("index, q = (MCP, PIP, DIP); {legend}"))?;
        let cells = body.split_evenly((2, 3));
        for (row, (_, key, value)) in quantities.into_iter().enumerate() {
            let magnitude = |losses: &Vec<fig2::Loss>| losses.iter().map(|loss| value(loss).abs()).fold(0.0, f64::max);
            // One scale for all postures, so that they can be compared.
            let top = (paper.losses.iter().map(magnitude).fold(0.0, f64::max) / 10.0).ceil() * 10.0;
            for (column, (q, losses)) in fig2::POSTURES_DEG.iter().zip(&paper.losses).enumerate() {
                let signed = key == "y_mm";
                let value = |loss: &fig2::Loss| if signed { value(loss) } else { value(loss).abs() };
                let Some(extremes) = fig2::extremes(losses, value) else { continue };
                let mm = |lengths: [f64; 3]| lengths.map(|length| data::round(length * MM));
                let points = losses.iter().map(|loss| (mm(loss.lengths), value(loss))).collect();
                Cloud {
                    title: format!("{}, q = ({}, {}, {})°", names[row], q[0], q[1], q[2]),
                    unit: if first == 0 { "deg" } else { "mm" },
                    scale: if signed { Scale::Signed } else { Scale::Magnitude },
                    range: if signed { -top..top } else { 0.0..top },
                    points,
                    max_at: mm(extremes.max_at),
                    min_at: mm(extremes.min_at),
                }
                .draw(&cells[row * 3 + column])?;
            }
        }
        Ok(())
    })?;
    let caption = "455 combinations of phalanx lengths, 10 to 50 mm in steps of 5 mm and at least as long as the \
                   master's index (37, 30, 15 mm) together."
        .to_owned();
    Ok(Figure { file: format!("{stem}.svg"), title: title.to_owned(), caption, svg })
}

fn gains(presets: &[Preset]) -> anyhow::Result<Figure> {
    let reach = presets.iter().map(|preset| preset.params.r2).fold(0.0, f64::max) * MM * 1.15;
    let svg = figure((560 * presets.len() as u32, 400), |root| {
        for (preset, area) in presets.iter().zip(root.split_evenly((1, presets.len()))) {
            let gain = data::gain(preset);
            let curve = |value: &dyn Fn(f64) -> f64, color, stroke| {
                let points = (0..=2000).map(|step| f64::from(step) / 2000.0 * reach);
                Curve { points: points.map(|delta| (delta, value(delta / MM))).collect(), color, stroke }
            };
            let (head, body) = area.split_vertically(34);
            legend(
                &head,
                (64, 20),
                &[("Eq. 14, corrected", color(Finger::Index), Stroke::Bold), ("as printed", PRINTED, Stroke::Dashed)],
            )?;
            Panel {
                title: &format!("{}: r1 = {:.0} mm, r2 = {:.0} mm", preset.name, gain.r1 * MM, gain.r2 * MM),
                x: ("distance of thumb tip and fingertip of the human hand [mm]", 0.0..reach),
                y: ("gain k", Some(-0.05..1.05)),
                curves: vec![
                    curve(&|delta| gain.at(delta), color(Finger::Index), Stroke::Bold),
                    curve(&|delta| fig4::as_printed(&gain, delta), PRINTED, Stroke::Dashed),
                ],
                bands: vec![(gain.r1 * MM, gain.r2 * MM)],
            }
            .draw(&body)?;
        }
        Ok(())
    })?;
    let caption = "The printed cosine starts at 0 instead of r1, so that it jumps at the radii; for r2 = 2 r1 it is \
                   inverted in between. Shaded: the transition between r1 and r2."
        .to_owned();
    Ok(Figure { file: "fig4.svg".to_owned(), title: "Fig. 4: the gain".to_owned(), caption, svg })
}

fn taps(hand: &HandModel, preset: &Preset) -> anyhow::Result<Figure> {
    const CELL: (i32, i32) = (440, 300);
    let shown = |gesture| preset.taps.iter().find(|taps| taps[0].gesture == gesture);
    let rows: Vec<&[Tap; 3]> = fig6::TAPS.into_iter().filter_map(shown).collect();
    let size = (CELL.0 as u32 * 4, 40 + CELL.1 as u32 * rows.len() as u32);
    let svg = figure(size, |root| {
        let (head, body) = root.split_vertically(40);
        for (column, name) in
            ["human hand", "joint mapping", "Cartesian mapping", "combined mapping"].into_iter().enumerate()
        {
            text(&head, (CELL.0 * column as i32 + CELL.0 / 2, 20), 17, HPos::Center, name)?;
        }
        let cells = body.split_evenly((rows.len(), 4));
        for (row, taps) in rows.iter().enumerate() {
            for column in 0..4 {
                let cell = &cells[row * 4 + column];
                area_frame(cell)?;
                let (palm, side) = cell.split_horizontally(CELL.0 * 54 / 100);
                let tap = &taps[column.saturating_sub(1)];
                let sample = &tap.samples[tap.peak];
                let (skeleton, centre, scale) = if column == 0 {
                    (Skeleton::master(&sample.pose, hand.side), MASTER_CENTRE, 1420.0)
                } else {
                    (Skeleton::slave(hand, &sample.output.q), SLAVE_CENTRE, 900.0)
                };
                for (area, view) in [(&palm, View::Palm), (&side, View::Thumb)] {
                    skeleton.draw(area, view, &centre, scale)?;
                    ruler(area, scale)?;
                }
                let said = if column == 0 { tap.gesture.name().replace('_', " ") } else { outcome(tap) };
                text(cell, (10, 14), 13, HPos::Left, &said)?;
            }
        }
        Ok(())
    })?;
    Ok(Figure {
        file: format!("fig6_{}.svg", preset.name),
        title: format!("Fig. 6: taps, preset {}", preset.name),
        caption:
            "Both hands at the instant of contact, from the palm and from the thumb's side. Dots are the poles of \
                  the fingertips, which the mapping controls."
                .to_owned(),
        svg,
    })
}

/// Tip distance and errors of the tapping finger at contact.
fn outcome(tap: &Tap) -> String {
    let opposing = tap.fingers.iter().find(|finger| finger.involved && finger.finger != Finger::Thumb);
    opposing.map_or_else(String::new, |finger| {
        format!(
            "tips {:.1} mm apart, {} e_Q {:.2} rad, e_C {:.1} mm",
            finger.distance_peak * MM,
            finger.finger.name(),
            finger.e_q_peak,
            finger.e_c_peak * MM
        )
    })
}

fn area_frame(area: &Area<'_>) -> anyhow::Result<()> {
    let (width, height) = area.dim_in_pixel();
    let frame = [(0, 0), (width as i32 - 1, height as i32 - 1)];
    Ok(area.draw(&Rectangle::new(frame, RGBColor(214, 217, 223).stroke_width(1)))?)
}

fn frames(hand: &HandModel, preset: &Preset, run: &Run) -> anyhow::Result<Figure> {
    // Open, before, within and after the transition, closed.
    let times = fig8::rise(&run.samples, Finger::Index);
    let last = fig8::rise(&run.samples, Finger::Middle).reaches;
    let instants = [0.0, times.leaves, times.half, last, fig8::MIRROR];
    let at = |t: f64| run.samples.iter().min_by(|a, b| (a.t - t).abs().total_cmp(&(b.t - t).abs()));
    let svg = figure((300 * instants.len() as u32, 40 + 300 + 380), |root| {
        let (head, body) = root.split_vertically(40);
        let marks = [("p_C", CARTESIAN), ("p_Q", JOINT), ("p_input", INK)];
        let mut x = 20;
        for (kind, (name, _)) in marks.iter().enumerate() {
            mark(&head, (x, 20), kind)?;
            text(&head, (x + 14, 20), 14, HPos::Left, &format!("{name}, thumb, index, middle"))?;
            x += 250;
        }
        let (masters, slaves) = body.split_vertically(300);
        let cells = masters.split_evenly((1, instants.len())).into_iter().zip(slaves.split_evenly((1, instants.len())));
        for ((above, below), instant) in cells.zip(instants) {
            let Some(sample) = at(instant) else { continue };
            for area in [&above, &below] {
                area_frame(area)?;
            }
            Skeleton::master(&sample.pose, hand.side).draw(&above, View::Palm, &MASTER_CENTRE, 1300.0)?;
            ruler(&above, 1300.0)?;
            let k = |finger| sample.output.finger(finger).map_or(0.0, |signals| signals.k);
            let said = format!("t = {:.1} s: k_I = {:.2}, k_M = {:.2}", sample.t, k(Finger::Index), k(Finger::Middle));
            text(&above, (10, 14), 13, HPos::Left, &said)?;
            let (centre, scale) = (Point::new(0.05, 0.055, 0.05), 800.0);
            let slave = Skeleton::slave(hand, &sample.output.q);
            slave.draw(&below, View::Palm, &centre, scale)?;
            ruler(&below, scale)?;
            for finger in FINGERS {
                let Some(signals) = sample.output.finger(finger) else { continue };
                for (kind, p) in [signals.p_cartesian, signals.p_joint, signals.p_input].into_iter().enumerate() {
                    let p = hand.anatomical_from_palm * p;
                    let place = slave.place(&below, View::Palm, &centre, scale, &p);
                    let (width, height) = below.dim_in_pixel();
                    if (8..width as i32 - 8).contains(&place.0) && (8..height as i32 - 8).contains(&place.1) {
                        mark(&below, place, kind)?;
                    }
                }
            }
        }
        Ok(())
    })?;
    Ok(Figure {
        file: format!("{}.svg", stem("fig7", preset, run.gesture)),
        title: format!("Fig. 7: {}, preset {}", said(run), preset.name),
        caption: "Both hands open, where the index enters the transition, in its middle, where the middle finger \
                  leaves it, and closed. Targets outside a picture are left out."
            .to_owned(),
        svg,
    })
}

/// A target: a cross (p_C), a square (p_Q) or a ring (p_input).
fn mark(area: &Area<'_>, (x, y): (i32, i32), kind: usize) -> anyhow::Result<()> {
    match kind {
        0 => {
            for line in [[(x - 5, y - 5), (x + 6, y + 6)], [(x - 5, y + 5), (x + 6, y - 6)]] {
                area.draw(&PathElement::new(line, CARTESIAN.stroke_width(3)))?;
            }
        }
        1 => area.draw(&Rectangle::new([(x - 5, y - 5), (x + 5, y + 5)], JOINT.stroke_width(2)))?,
        _ => area.draw(&Circle::new((x, y), 8, INK.stroke_width(2)))?,
    }
    Ok(())
}

fn said(run: &Run) -> &'static str {
    if run.gesture == super::TRIPODS[0] { "tripod" } else { "curled tripod" }
}

fn signals(hand: &HandModel, preset: &Preset, run: &Run) -> anyhow::Result<Figure> {
    let svg = figure((1500, 1560), |root| {
        let (head, body) = root.split_vertically(40);
        let legend_entries = [
            ("p_input", INK, Stroke::Solid),
            ("p_C, Cartesian mapping", CARTESIAN, Stroke::Dashed),
            ("p_Q, joint mapping", GREY, Stroke::Bold),
        ];
        legend(&head, (60, 20), &legend_entries)?;
        let cells = body.split_evenly((6, FINGERS.len()));
        for (column, finger) in FINGERS.into_iter().enumerate() {
            let values = |value: &dyn Fn(&FingerSignals) -> f64| -> Vec<(f64, f64)> {
                let value = |signals: &FingerSignals| value(signals);
                let at = |sample: &teleop_common::paper::motion::Sample| {
                    (sample.t, sample.output.finger(finger).map_or(f64::NAN, value))
                };
                run.samples.iter().map(at).collect()
            };
            let own = |value: &dyn Fn(&FingerSignals) -> f64| Curve {
                points: values(value),
                color: color(finger),
                stroke: Stroke::Solid,
            };
            let x = ("t [s]", 0.0..80.0);
            let title = finger.name();
            let bands = transitions(run, finger);
            let panel = |title, y, curves| Panel { title, x: x.clone(), y, curves, bands: bands.clone() };
            let mut panels = vec![panel(title, ("gain k", Some(-0.05..1.05)), vec![own(&|s| s.k)])];
            for (axis, name) in ["radial x [mm]", "distal y [mm]", "palmar z [mm]"].into_iter().enumerate() {
                let point = |value: fn(&FingerSignals) -> Point, color, stroke| Curve {
                    points: values(&|signals| (hand.anatomical_from_palm * value(signals))[axis] * MM),
                    color,
                    stroke,
                };
                let curves = vec![
                    point(|signals| signals.p_joint, GREY, Stroke::Bold),
                    point(|signals| signals.p_cartesian, CARTESIAN, Stroke::Dashed),
                    point(|signals| signals.p_input, INK, Stroke::Solid),
                ];
                panels.push(panel("", (name, None), curves));
            }
            panels.push(panel("", ("e_Q [rad]", None), vec![own(&|s| s.e_q)]));
            panels.push(panel("", ("e_C [mm]", None), vec![own(&|s| s.e_c * MM)]));
            for (row, panel) in panels.iter().enumerate() {
                panel.draw(&cells[row * FINGERS.len() + column])?;
            }
        }
        Ok(())
    })?;
    Ok(Figure {
        file: format!("{}.svg", stem("fig8", preset, run.gesture)),
        title: format!("Fig. 8: {}, preset {}", said(run), preset.name),
        caption: "Gain, targets of the tip in the hand's frame, and errors against the joint mapping (e_Q) and the \
                  Cartesian mapping (e_C). Shaded: the transition, 0 &lt; k &lt; 1."
            .to_owned(),
        svg,
    })
}

/// When the finger's gain is between 0 and 1, s.
fn transitions(run: &Run, finger: Finger) -> Vec<(f64, f64)> {
    let within = |signals: &FingerSignals| signals.k > 0.0 && signals.k < 1.0;
    let mut out: Vec<(f64, f64)> = Vec::new();
    let mut inside = false;
    for sample in &run.samples {
        let now = sample.output.finger(finger).is_some_and(within);
        match out.last_mut() {
            Some((_, end)) if now && inside => *end = sample.t,
            _ if now => out.push((sample.t, sample.t)),
            _ => {}
        }
        inside = now;
    }
    out
}

fn smoothness(paper: &Paper) -> anyhow::Result<Figure> {
    let base = [color(Finger::Ring), color(Finger::Index)];
    let mut colors = Vec::new();
    let mut names = Vec::new();
    for (preset, base) in paper.presets.iter().zip(base.into_iter().cycle()) {
        for (stage, share) in super::STAGES.iter().zip([0.45, 1.0]) {
            let mix = |part: u8| (f64::from(part) * share + 255.0 * (1.0 - share)) as u8;
            colors.push(RGBColor(mix(base.0), mix(base.1), mix(base.2)));
            names.push(format!("{}, {stage} conditioning", preset.name));
        }
    }
    let limit = limit_value(&paper.hand);
    let svg = figure((1500, 900), |root| {
        let (head, body) = root.split_vertically(40);
        let entries: Vec<_> =
            names.iter().zip(&colors).map(|(name, color)| (name.as_str(), *color, Stroke::Bold)).collect();
        legend(&head, (60, 22), &entries)?;
        for (cell, (name, unit, value)) in body.split_evenly((2, 2)).iter().zip(data::SMOOTHNESS) {
            let gestures = paper.presets.first().map_or(&[][..], |preset| &preset.smoothness);
            let group = |index: usize| {
                let of = |preset: &Preset| preset.smoothness[index].1.map(|smoothness| value(&smoothness));
                let name = gestures[index].0.name().replace('_', " ");
                (name, paper.presets.iter().flat_map(of).collect())
            };
            let named = format!("limit of the joints, {limit:.1} rad/s");
            Bars {
                title: &name.replace("peak_speed", "peak joint speed").replace("rms", "RMS").replace('_', " "),
                unit: if unit == "rad_s" { "rad/s" } else { "rad/s³" },
                groups: (0..gestures.len()).map(group).collect(),
                colors: &colors,
                limit: (name == "peak_speed").then_some((limit, named.as_str())),
            }
            .draw(cell)?;
        }
        Ok(())
    })?;
    Ok(Figure {
        file: "smoothness.svg".to_owned(),
        title: "Smoothness of the joints, before and after conditioning".to_owned(),
        caption:
            "Gestures of 4.5 s (2 s to close, 0.5 s rest, 2 s to open) sampled every 10 ms, worst joint. Before: what \
                  the mapping asks for; after: what the control loop commands. The axes are logarithmic."
                .to_owned(),
        svg,
    })
}

/// The smallest velocity limit, rad/s.
fn limit_value(hand: &HandModel) -> f64 {
    hand.joints.iter().map(|joint| joint.velocity).fold(f64::INFINITY, f64::min)
}
