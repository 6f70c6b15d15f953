//! One page with everything.

use std::fmt::Write as _;

use serde_json::Value;
use teleop_common::hand::Finger;
use teleop_common::master::Gesture;
use teleop_common::paper::fig2;
use teleop_common::paper::{Check, fig6};

use super::data::{self, MM, mode_name};
use super::figures::Figure;
use super::{Paper, Preset, STAGES};

const HEAD: &str = r#"<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Combined joint-Cartesian mapping: the paper's tables and figures</title>
<style>
body { font: 15px/1.5 "DejaVu Sans", Verdana, sans-serif; color: #282a30; max-width: 1500px; margin: 24px auto; padding: 0 20px; }
h1 { font-size: 24px; } h2 { font-size: 19px; margin-top: 2em; border-bottom: 1px solid #d6d9df; } h3 { font-size: 16px; }
table { border-collapse: collapse; margin: 8px 0 16px; font-size: 14px; }
th, td { border: 1px solid #d6d9df; padding: 3px 10px; text-align: right; vertical-align: top; }
th { background: #f1f3f6; } td.text, th.text { text-align: left; }
td.yes { background: #e0f4e6; } td.no { background: #fbdcdc; } td.open { background: #fff3d0; }
img { max-width: 100%; border: 1px solid #e4e7ec; } figcaption, .note { color: #5a606a; font-size: 14px; }
figure { margin: 12px 0 24px; }
</style></head><body>
"#;

/// The page, which refers to the figures' files beside it.
pub(super) fn page(paper: &Paper, figures: &[Figure]) -> String {
    let mut out = HEAD.to_owned();
    let write = &mut out;
    write!(
        write,
        "<h1>Combined joint-Cartesian mapping: the paper's tables and figures</h1>\n<p>Meattini, Chiaravalli, Palli, \
         Melchiorri (IFAC 2020), computed by <code>robot paper</code> {} for the {}. Everything is computed by the \
         program's own mapping. The equations are corrected where the printed ones cannot be meant, and the paper \
         gives neither r1 and r2 nor the postures of Fig. 2, so figures show the stated choices, not the authors' \
         data. The master is the paradigmatic hand of Table 1; positions are of the outermost points (poles) of the \
         fingertips, in the frame x radial, y distal, z palmar.</p>\n",
        env!("CARGO_PKG_VERSION"),
        paper.hand.name
    )
    .ok();
    summary(write, paper);
    heading(write, "Table 1: the hands");
    table1(write, &data::table1(&paper.hand));
    heading(write, "Fig. 2: what each plain mapping loses");
    fig2(write, &data::fig2(&paper.losses));
    show(write, figures, "fig2");
    heading(write, "Fig. 4: the gain over the distance");
    show(write, figures, "fig4");
    heading(write, "Fig. 6: taps under joint, Cartesian and combined mapping");
    show(write, figures, "fig6");
    taps(write, &paper.presets);
    heading(write, "Fig. 7 and 8: the tripod, 80 s");
    for preset in &paper.presets {
        for run in &preset.fig8 {
            for figure in ["fig7", "fig8"] {
                show(write, figures, &format!("{}.", super::stem(figure, preset, run.gesture)));
            }
        }
    }
    heading(write, "Smoothness");
    show(write, figures, "smoothness");
    smoothness(write, &paper.presets);
    values(write, paper);
    files(write, paper);
    out.push_str("</body></html>\n");
    out
}

fn heading(out: &mut String, text: &str) {
    writeln!(out, "<h2>{text}</h2>").ok();
}

fn show(out: &mut String, figures: &[Figure], prefix: &str) {
    for figure in figures.iter().filter(|figure| figure.file.starts_with(prefix)) {
        writeln!(
            out,
            "<figure><h3>{}</h3><img src=\"{}\" alt=\"{}\"><figcaption>{}</figcaption></figure>",
            figure.title, figure.file, figure.title, figure.caption
        )
        .ok();
    }
}

/// A table; the first `texts` columns are text.
fn table(out: &mut String, head: &[&str], texts: usize, rows: impl IntoIterator<Item = Vec<String>>) {
    let class = |column: usize| if column < texts { " class=\"text\"" } else { "" };
    out.push_str("<table><tr>");
    head.iter().enumerate().for_each(|(column, name)| write!(out, "<th{}>{name}</th>", class(column)).unwrap_or(()));
    out.push_str("</tr>\n");
    for row in rows {
        out.push_str("<tr>");
        row.iter().enumerate().for_each(|(column, cell)| write!(out, "<td{}>{cell}</td>", class(column)).unwrap_or(()));
        out.push_str("</tr>\n");
    }
    out.push_str("</table>\n");
}

/// What holds, one column per preset and motion.
fn summary(out: &mut String, paper: &Paper) {
    heading(out, "What holds");
    matrix(out, paper.presets.iter().flat_map(|preset| preset.fig8_checks().map(move |own| (preset, own))).collect());
    matrix(out, paper.presets.iter().flat_map(|preset| preset.tap_checks().map(move |own| (preset, own))).collect());
}

fn matrix(out: &mut String, columns: Vec<(&Preset, (Gesture, &[Check]))>) {
    out.push_str("<table><tr><th class=\"text\">check</th><th class=\"text\">statement</th>");
    for (preset, (gesture, _)) in &columns {
        write!(out, "<th>{}<br>{}</th>", preset.name, gesture.name().replace('_', " ")).ok();
    }
    out.push_str("</tr>\n");
    let mut notes = String::new();
    for (row, check) in columns.first().map_or(&[][..], |(_, (_, checks))| checks).iter().enumerate() {
        let statement = escape(&check.statement);
        write!(out, "<tr><td class=\"text\">{}</td><td class=\"text\">{statement}</td>", check.name).ok();
        for (preset, (gesture, checks)) in &columns {
            let Some(check) = checks.get(row) else { continue };
            let (class, holds) = match check.holds {
                Some(true) => ("yes", "yes"),
                Some(false) => ("no", "NO"),
                None => ("open", "not asserted"),
            };
            write!(out, "<td class=\"{class}\">{holds}</td>").ok();
            if !check.note.is_empty() {
                writeln!(notes, "{} of {gesture}, preset {}: {}.<br>", check.name, preset.name, check.note).ok();
            }
        }
        out.push_str("</tr>\n");
    }
    writeln!(out, "</table>\n<p class=\"note\">{notes}</p>").ok();
}

/// The numbers behind [`summary`].
fn values(out: &mut String, paper: &Paper) {
    heading(out, "Values behind the checks");
    let mut rows = Vec::new();
    for preset in &paper.presets {
        for (gesture, checks) in preset.fig8_checks().chain(preset.tap_checks()) {
            for check in checks {
                let values = check.values.iter().map(|(name, value)| format!("{name} {}", short(*value)));
                let values = values.collect::<Vec<_>>().join(", ");
                rows.push(vec![preset.name.clone(), gesture.to_string(), check.name.to_owned(), values]);
            }
        }
    }
    table(out, &["preset", "motion", "check", "values"], 4, rows);
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

/// Few digits, for people.
fn short(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        size if size < 1e-3 => format!("{value:.1e}"),
        size if size < 10.0 => format!("{value:.3}"),
        size if size < 1000.0 => format!("{value:.1}"),
        _ => format!("{value:.0}"),
    }
}

fn table1(out: &mut String, table1: &Value) {
    let lengths = |value: &Value| {
        let numbers: Vec<_> = value
            .as_array()
            .into_iter()
            .flatten()
            .filter_map(Value::as_f64)
            .map(|length| format!("{length}"))
            .collect();
        if numbers.is_empty() { "-".to_owned() } else { numbers.join(" / ") }
    };
    let row = |finger: &Value| {
        let name = finger["finger"].as_str().unwrap_or_default().to_owned();
        let [master, printed, model] =
            ["master_mm", "slave_printed_mm", "slave_model_mm"].map(|key| lengths(&finger[key]));
        vec![name, master, printed, model]
    };
    let head = ["finger", "paradigmatic hand [mm]", "Allegro, as printed [mm]", "Allegro, of the model [mm]"];
    table(out, &head, 1, table1["fingers"].as_array().into_iter().flatten().map(row));
    let ratios = table1["d"].as_array().into_iter().flatten().map(|ratio| {
        format!("d({}, {}) = {}", ratio["from"].as_str().unwrap_or(""), ratio["to"].as_str().unwrap_or(""), ratio["d"])
    });
    writeln!(
        out,
        "<p>c_s = {} with the printed thumbs, {} with the model's; {}.</p>",
        table1["c_s"],
        table1["c_s_model"],
        ratios.collect::<Vec<_>>().join(", ")
    )
    .ok();
}

fn fig2(out: &mut String, fig2: &Value) {
    let number = |value: &Value| value.as_f64().map_or_else(|| "-".to_owned(), |value| format!("{value:.3}"));
    let lengths = |value: &Value| {
        value
            .as_array()
            .into_iter()
            .flatten()
            .filter_map(Value::as_f64)
            .map(|length| length.to_string())
            .collect::<Vec<_>>()
            .join(", ")
    };
    let names = [
        "Cartesian mapping, |q2 error| [deg]",
        "Cartesian mapping, posture error, norm [deg]",
        "joint mapping, tip error along y [mm]",
        "joint mapping, tip error, norm [mm]",
    ];
    let mut rows = Vec::new();
    for (posture, q) in fig2["postures"].as_array().into_iter().flatten().zip(fig2::POSTURES_DEG) {
        for ((object, key, _), name) in data::FIG2.iter().zip(names) {
            let extremes = &posture[object][key];
            let [max_at, min_at] = ["max_at", "min_at"].map(|key| lengths(&extremes[key]));
            let [max, min, mean] = ["max", "min", "mean"].map(|key| number(&extremes[key]));
            let q = format!("{}, {}, {}", q[0], q[1], q[2]);
            rows.push(vec![q, name.to_owned(), max, max_at, min, min_at, mean]);
        }
    }
    writeln!(out, "<p>{} combinations. Largest, smallest and mean are of magnitudes.</p>", fig2["combinations"]).ok();
    table(
        out,
        &["q [deg]", "error", "largest", "at a1, a2, a3 [mm]", "smallest", "at a1, a2, a3 [mm]", "mean"],
        2,
        rows,
    );
}

fn taps(out: &mut String, presets: &[Preset]) {
    let mut rows = Vec::new();
    for preset in presets {
        for tap in preset.taps.iter().flatten() {
            for finger in tap.fingers.iter().filter(|finger| finger.involved) {
                let distance = |value: f64| {
                    if finger.finger == Finger::Thumb { "-".to_owned() } else { format!("{:.2}", value * MM) }
                };
                rows.push(vec![
                    preset.name.clone(),
                    tap.gesture.to_string(),
                    mode_name(tap.mode).to_owned(),
                    finger.finger.name().to_owned(),
                    format!("{:.3}", finger.e_q_peak),
                    format!("{:.3}", finger.e_q_mean),
                    format!("{:.2}", finger.e_c_peak * MM),
                    format!("{:.2}", finger.e_c_mean * MM),
                    distance(finger.distance_peak),
                    distance(finger.distance_error_peak),
                    distance(finger.distance_error_rms),
                ]);
            }
        }
    }
    let head = [
        "preset",
        "gesture",
        "mapping",
        "finger",
        "e_Q at contact [rad]",
        "e_Q mean [rad]",
        "e_C at contact [mm]",
        "e_C mean [mm]",
        "tip distance at contact [mm]",
        "minus c_s delta [mm]",
        "RMS of that within r1 [mm]",
    ];
    out.push_str("<p>Fingers that the gesture moves, at contact and over the motion.</p>\n");
    table(out, &head, 4, rows);
}

fn smoothness(out: &mut String, presets: &[Preset]) {
    let mut rows = Vec::new();
    for preset in presets {
        for (gesture, stages) in &preset.smoothness {
            for (stage, smoothness) in STAGES.iter().zip(stages) {
                let mut row = vec![preset.name.clone(), gesture.to_string(), (*stage).to_owned()];
                row.extend(data::SMOOTHNESS.iter().map(|(_, _, value)| short(value(smoothness))));
                rows.push(row);
            }
        }
    }
    let head = [
        "preset",
        "gesture",
        "conditioning",
        "peak speed [rad/s]",
        "velocity jump [rad/s]",
        "peak jerk [rad/s³]",
        "RMS jerk [rad/s³]",
    ];
    table(out, &head, 3, rows);
}

fn files(out: &mut String, paper: &Paper) {
    heading(out, "Files");
    let presets: Vec<_> = paper.presets.iter().map(|preset| preset.name.as_str()).collect();
    let presets = presets.join(" or ");
    let rows = [
        ("summary.json", "the checks above, with the presets' parameters"),
        ("table1.json", "Table 1"),
        ("fig2.json, fig2.csv", "Fig. 2: extremes and means; every combination"),
        ("fig4.csv", "Fig. 4"),
        ("fig6.json, fig6.csv", "Fig. 6: every gesture, mapping and finger"),
        (
            "fig8_PRESET.csv, fig8_PRESET_close.csv",
            "Fig. 8, one row per 0.1 s: t in s; delta, e_c and positions in mm \
          (x radial, y distal, z palmar); e_q in rad; k from 0 (joint) to 1 (Cartesian). p_c, p_q, p_input: targets; p: reached",
        ),
        ("smoothness.json, smoothness.csv", "smoothness"),
        ("paper.rrd", "Fig. 2 and 8 to turn and play: `rerun paper.rrd`"),
    ];
    writeln!(
        out,
        "<p>PRESET is {presets}. Taps: {} at {:.0} Hz.</p>",
        fig6::TAPS.map(|tap| tap.name()).join(", "),
        fig6::RATE
    )
    .ok();
    table(
        out,
        &["file", "content"],
        2,
        rows.map(|(file, content)| vec![format!("<code>{file}</code>"), content.to_owned()]),
    );
}
