//! Pictures of both hands: skeletons from their kinematics, in parallel projection.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use teleop_common::hand::{Finger, HandModel, HandSide, Shape};
use teleop_common::master::MasterPose;
use teleop_common::paper::table1;

use super::plot::{Area, GREY, INK, color, text};

type Point = nalgebra::Vector3<f64>;

/// From where a hand is looked at. Points are in the anatomical frame: radial, distal, palmar.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum View {
    /// From the palm, a little from the thumb's side and from above.
    Palm,
    /// From the thumb's side.
    Thumb,
}

impl View {
    /// Right, up, and towards the eye.
    fn project(self, p: &Point, side: HandSide) -> [f64; 3] {
        // Towards the eye, as in the live picture, and straight from the side.
        let eye: Point = match self {
            Self::Palm => Point::new(0.42, 0.18, 0.889),
            Self::Thumb => Point::new(0.99, 0.10, 0.10),
        }
        .normalize();
        let right = Point::y().cross(&eye).normalize();
        let up = eye.cross(&right);
        // A left hand is the mirror image.
        let mirror = if side == HandSide::Left { -1.0 } else { 1.0 };
        [right.dot(p) * mirror, up.dot(p), eye.dot(p)]
    }
}

/// A hand in the anatomical frame, m.
pub(super) struct Skeleton {
    fingers: Vec<(Finger, Vec<Point>)>,
    /// Corners of the palm.
    palm: Vec<Point>,
    side: HandSide,
    /// Radius of a finger, m.
    radius: f64,
}

impl Skeleton {
    pub(super) fn master(pose: &MasterPose, side: HandSide) -> Self {
        let fingers: Vec<_> = Finger::ALL
            .map(|finger| (finger, pose.geometry.finger_points(finger, &pose.finger(finger)).to_vec()))
            .into();
        let mut palm: Vec<_> = fingers.iter().map(|(_, points)| points[0]).collect();
        palm.extend([Point::new(0.022, 0.0, 0.0), Point::new(-0.022, 0.0, 0.0)]);
        Self { fingers, palm, side, radius: 0.006 }
    }

    pub(super) fn slave(hand: &HandModel, q: &[f64]) -> Self {
        let fingers = hand.fingers.iter().map(|chain| (chain.finger, table1::points(hand, chain, &chain.select(q))));
        let mut palm = Vec::new();
        for visual in hand.links.first().map_or(&[][..], |link| &link.visuals) {
            if let Shape::Box { size } = visual.shape {
                for corner in 0..8_usize {
                    let sign = |axis: usize| if corner >> axis & 1 == 1 { 0.5 } else { -0.5 };
                    let local = nalgebra::Point3::new(size[0] * sign(0), size[1] * sign(1), size[2] * sign(2));
                    palm.push(hand.anatomical_from_palm * (visual.origin * local).coords);
                }
            }
        }
        Self { fingers: fingers.collect(), palm, side: hand.side, radius: 0.008 }
    }

    /// Draws the hand with the point `centre` (m, anatomical) in the middle of the area, `scale` px per m.
    pub(super) fn draw(&self, area: &Area<'_>, view: View, centre: &Point, scale: f64) -> anyhow::Result<()> {
        let place = |p: &Point| self.place(area, view, centre, scale, p);
        let hull = convex_hull(self.palm.iter().map(&place).collect());
        area.draw(&Polygon::new(hull.clone(), RGBColor(228, 230, 234).filled()))?;
        let outline: Vec<_> = hull.iter().chain(hull.first()).copied().collect();
        area.draw(&PathElement::new(outline, GREY.stroke_width(1)))?;

        let depth = |p: &Point| view.project(p, self.side)[2];
        let mut bones = Vec::new();
        for (finger, points) in &self.fingers {
            for (bone, pair) in points.windows(2).enumerate() {
                bones.push((depth(&pair[0]) + depth(&pair[1]), *finger, pair, bone + 2 == points.len()));
            }
        }
        bones.sort_by(|a, b| a.0.total_cmp(&b.0));
        let width = (self.radius * 2.0 * scale) as u32;
        for (_, finger, pair, last) in bones {
            let (from, to) = (place(&pair[0]), place(&pair[1]));
            // A white edge tells what lies before what.
            area.draw(&PathElement::new([from, to], WHITE.stroke_width(width + 4)))?;
            for end in [from, to] {
                area.draw(&Circle::new(end, width / 2, color(finger).filled()))?;
            }
            area.draw(&PathElement::new([from, to], color(finger).stroke_width(width)))?;
            area.draw(&Circle::new(from, 2, WHITE.filled()))?;
            if last {
                area.draw(&Circle::new(to, 3, INK.filled()))?;
            }
        }
        Ok(())
    }

    pub(super) fn place(&self, area: &Area<'_>, view: View, centre: &Point, scale: f64, p: &Point) -> (i32, i32) {
        let (width, height) = area.dim_in_pixel();
        let [x, y, _] = view.project(&(p - centre), self.side);
        ((f64::from(width) / 2.0 + x * scale).round() as i32, (f64::from(height) / 2.0 - y * scale).round() as i32)
    }
}

/// A length of 50 mm at the bottom right.
pub(super) fn ruler(area: &Area<'_>, scale: f64) -> anyhow::Result<()> {
    let (width, height) = area.dim_in_pixel();
    let (right, y) = (width as i32 - 12, height as i32 - 8);
    let left = right - (0.05 * scale) as i32;
    for line in [[(left, y), (right, y)], [(left, y - 3), (left, y + 3)], [(right, y - 3), (right, y + 3)]] {
        area.draw(&PathElement::new(line, GREY.stroke_width(1)))?;
    }
    text(area, ((left + right) / 2, y - 9), 11, HPos::Center, "50 mm")
}

/// Corners of the convex hull in order (Andrew's monotone chain).
fn convex_hull(mut points: Vec<(i32, i32)>) -> Vec<(i32, i32)> {
    points.sort_unstable();
    points.dedup();
    let half = |points: &mut dyn Iterator<Item = (i32, i32)>| {
        let mut chain: Vec<(i32, i32)> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..] {
                if (b.0 - a.0) * (point.1 - a.1) - (b.1 - a.1) * (point.0 - a.0) > 0 {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}
