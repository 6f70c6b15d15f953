//! One colour per meaning, in 3D and in the plots. Okabe-Ito hues, which people with any colour vision can tell
//! apart, lightened for a dark background.

use rerun::Color;

use crate::hand::Finger;

pub(super) const PALM: Color = rgb(150, 155, 165);
/// p_Q, what the joint mapping asks for.
pub(super) const JOINT: Color = rgb(255, 255, 255);
/// p_C, what the Cartesian mapping asks for.
pub(super) const CARTESIAN: Color = rgb(255, 92, 58);
/// p_input, the blend.
pub(super) const BLEND: Color = rgb(255, 226, 60);
/// The commanded posture, where it differs from the measured one.
pub(super) const COMMAND: Color = rgb(255, 255, 255);
pub(super) const FAINT: Color = rgb(120, 125, 135);

pub(super) const fn rgb(r: u8, g: u8, b: u8) -> Color {
    rgba(r, g, b, 255)
}

pub(super) const fn rgba(r: u8, g: u8, b: u8, a: u8) -> Color {
    Color(rerun::datatypes::Rgba32(u32::from_be_bytes([r, g, b, a])))
}

pub(super) const fn finger(finger: Finger) -> Color {
    let [r, g, b] = finger_rgb(finger);
    rgb(r, g, b)
}

/// The finger's colour everywhere, made for a dark background: red, green, blue.
#[must_use]
pub const fn finger_rgb(finger: Finger) -> [u8; 3] {
    match finger {
        Finger::Thumb => [240, 170, 40],
        Finger::Index => [86, 180, 233],
        Finger::Middle => [40, 200, 140],
        Finger::Ring => [220, 130, 180],
        Finger::Little => [225, 215, 80],
    }
}

/// A magnitude between 0 and 1: violet over green to yellow, equally bright steps. Red, green, blue.
#[must_use]
pub fn heat(share: f64) -> [u8; 3] {
    const STOPS: [[f64; 3]; 5] =
        [[68.0, 1.0, 84.0], [59.0, 82.0, 139.0], [33.0, 145.0, 140.0], [94.0, 201.0, 98.0], [253.0, 231.0, 37.0]];
    let at = share.clamp(0.0, 1.0) * (STOPS.len() - 1) as f64;
    let below = (at as usize).min(STOPS.len() - 2);
    std::array::from_fn(|i| (STOPS[below][i] + (STOPS[below + 1][i] - STOPS[below][i]) * (at - below as f64)) as u8)
}

/// The joint `slot` of a finger, palm outwards.
pub(super) const fn joint(slot: usize) -> Color {
    match slot {
        0 => rgb(240, 170, 40),
        1 => rgb(86, 180, 233),
        2 => rgb(40, 200, 140),
        3 => rgb(220, 130, 180),
        _ => rgb(225, 215, 80),
    }
}

/// `color` mixed with the background's grey: 0 all grey, 1 all colour.
pub(super) fn fade(color: Color, share: f64) -> Color {
    let share = share.clamp(0.0, 1.0);
    let mix = |c: u8, grey: u8| (f64::from(c) * share + f64::from(grey) * (1.0 - share)) as u8;
    let [r, g, b, a] = color.0.to_array();
    let [gr, gg, gb, _] = rgb(70, 74, 82).0.to_array();
    rgba(mix(r, gr), mix(g, gg), mix(b, gb), a)
}
