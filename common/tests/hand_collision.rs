//! The hand as capsules: what the URDF says, no more and not much less.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "tests")]

use nalgebra::Vector3;
use teleop_common::hand::{Body, Capsule, HandModel, HandSide, allegro_v4_texts};

const SIDES: [HandSide; 2] = [HandSide::Right, HandSide::Left];
/// The collision shape of link_0.0.
const BOX_0: &str = "<box size=\"0.0196 0.0275 0.0164\"/>";

/// Replaces the first `from`, which must be there.
#[track_caller]
fn edit(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "nothing to replace: {from}");
    text.replacen(from, to, 1)
}

fn without_collisions(urdf: &str) -> String {
    let mut parts = urdf.split("<collision>");
    let mut out = parts.next().unwrap().to_owned();
    parts.for_each(|part| out.push_str(part.split_once("</collision>").unwrap().1));
    out
}

fn body<'a>(hand: &'a HandModel, link: &str) -> &'a Body {
    hand.collision.fingers.iter().flatten().find(|body| body.link == link).unwrap()
}

/// How far a point is outside of the nearest capsule, m.
fn outside(capsules: &[Capsule], point: Vector3<f64>) -> f64 {
    let own = |capsule: &Capsule| {
        let along = capsule.ends[1] - capsule.ends[0];
        let t = ((point - capsule.ends[0]).dot(&along) / along.norm_squared().max(1e-30)).clamp(0.0, 1.0);
        (point - capsule.ends[0] - along * t).norm() - capsule.radius
    };
    capsules.iter().map(own).fold(f64::INFINITY, f64::min)
}

#[test]
fn capsules_reach_the_faces_of_the_boxes_and_stay_inside() {
    for side in SIDES {
        let (urdf, _) = allegro_v4_texts(side);
        let (hand, robot) = (HandModel::allegro_v4(side), urdf_rs::read_from_string(urdf).unwrap());
        let (mut boxes, mut edges) = (0, 0.0_f64);
        for link in &robot.links {
            let Some(collision) = link.collision.first() else { continue };
            let center = Vector3::from(*collision.origin.xyz);
            match &collision.geometry {
                urdf_rs::Geometry::Box { size } if link.name == "palm_link" => {
                    let [palm] = hand.collision.palm.as_slice() else { panic!("one box of the palm") };
                    assert!((palm.center - center).norm() < 1e-12);
                    assert!((palm.half.map(|half| 2.0 * (half + palm.radius)) - Vector3::from(**size)).norm() < 1e-12);
                }
                urdf_rs::Geometry::Box { size } => {
                    boxes += 1;
                    let half = Vector3::from(**size) * 0.5;
                    let body = body(&hand, &link.name);
                    for own in &body.capsules {
                        for end in own.ends {
                            let room = half - (end - center).abs();
                            assert!(room.min() > own.radius - 1e-9, "{}: {room}", link.name);
                        }
                        let around = std::slice::from_ref(&body.bound);
                        let most = own.ends.map(|end| outside(around, end) + own.radius);
                        assert!(most.iter().all(|most| *most < 1e-9), "{}: not in its bound", link.name);
                    }
                    for axis in 0..3 {
                        for sign in [-1.0, 1.0] {
                            let mut face = center;
                            face[axis] += sign * half[axis];
                            assert!(outside(&body.capsules, face) < 0.0015, "{}: face {axis} is bare", link.name);
                        }
                    }
                    // Around a finger, half way along it.
                    if !["link_12.0", "link_13.0"].contains(&link.name.as_str()) && half.z > 0.01 {
                        edges = edges.max(outside(&body.capsules, center + Vector3::new(half.x, half.y, 0.0)));
                    }
                }
                urdf_rs::Geometry::Sphere { radius } => {
                    let tip = body(&hand, &link.name);
                    assert!(tip.tip && tip.capsules.len() == 1 && (tip.capsules[0].radius - radius).abs() < 1e-12);
                }
                other => panic!("{}: {other:?}", link.name),
            }
        }
        assert_eq!(boxes, 16);
        assert!(edges < 0.0046, "the edges of a finger stand out by {edges} m");
        assert!(hand.collision.fingers.iter().all(|bodies| bodies.len() == 5), "four links and a tip, nothing twice");
    }
}

#[test]
fn what_is_not_kept_apart_is_in_the_description() {
    for side in SIDES {
        let (_, description) = allegro_v4_texts(side);
        let collision = HandModel::allegro_v4(side).collision;
        let listed = description.lines().find_map(|line| line.strip_prefix("#   palm_link and ")).unwrap();
        let mut listed: Vec<&str> = listed.split(", ").collect();
        assert!(collision.ignored.iter().all(|[_, palm]| palm == "palm_link"), "{:?}", collision.ignored);
        let mut ignored: Vec<&str> = collision.ignored.iter().map(|[link, _]| link.as_str()).collect();
        listed.sort_unstable();
        ignored.sort_unstable();
        assert_eq!(listed, ignored);
        // Of five bodies of four fingers each.
        assert_eq!((collision.pairs.len(), collision.palm_pairs.len()), (6 * 25, 4 * 3));
    }
}

#[test]
fn every_shape_becomes_capsules() {
    let (urdf, description) = allegro_v4_texts(HandSide::Right);
    let capsules = |shape: &str| {
        let hand = HandModel::load(&edit(urdf, BOX_0, shape), description).unwrap();
        assert!(hand.warnings.is_empty(), "{:?}", hand.warnings);
        body(&hand, "link_0.0").capsules.clone()
    };
    let center = Vector3::new(0.0, 0.0, 0.0082);
    let along = |half: f64| [center - Vector3::z() * half, center + Vector3::z() * half];
    let same = |own: &Capsule, ends: [Vector3<f64>; 2], radius: f64| {
        let off = own.ends.iter().zip(ends).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        assert!(off < 1e-12 && (own.radius - radius).abs() < 1e-12, "{own:?}");
    };
    let sphere = capsules("<sphere radius=\"0.01\"/>");
    same(&sphere[0], along(0.0), 0.01);
    same(&capsules("<capsule radius=\"0.01\" length=\"0.03\"/>")[0], along(0.015), 0.01);
    same(&capsules("<cylinder radius=\"0.01\" length=\"0.05\"/>")[0], along(0.015), 0.01);
    same(&capsules("<box size=\"0.02 0.021 0.05\"/>")[0], along(0.015), 0.01);
    // A disc and a thin plate: some, and bounded.
    let disc = capsules("<cylinder radius=\"0.02\" length=\"0.02\"/>");
    assert!(disc.len() > 1 && outside(&disc, center + Vector3::new(0.0, 0.0, 0.01)) < 0.002, "{disc:?}");
    assert!((2..=8).contains(&capsules("<box size=\"0.04 0.0001 0.04\"/>").len()));
}

#[test]
fn what_cannot_be_watched_is_said() {
    let (urdf, description) = allegro_v4_texts(HandSide::Right);
    let hand = HandModel::load(&without_collisions(urdf), description).unwrap();
    assert_eq!(hand.warnings, ["no collision shapes: only the fingertips are kept apart"]);
    assert!(hand.collision.palm.is_empty() && hand.collision.fingers.iter().all(|bodies| bodies.len() == 1));
    assert_eq!((hand.collision.pairs.len(), hand.collision.palm_pairs.len()), (6, 0));

    let mesh = edit(urdf, BOX_0, "<mesh filename=\"package://a/link.stl\"/>");
    let hand = HandModel::load(&mesh, description).unwrap();
    assert_eq!(
        hand.warnings,
        ["link 'link_0.0': collision mesh 'package://a/link.stl' is not watched; only box, cylinder, capsule and \
          sphere are"]
    );

    let refused = |urdf: &str, expected: &str| {
        let error = HandModel::load(urdf, description).unwrap_err().to_string();
        assert!(error.contains(expected), "says: {error}\n  not: {expected}");
    };
    for (shape, value) in [
        ("<sphere radius=\"0\"/>", "0"),
        ("<box size=\"0.01 -0.01 0.01\"/>", "-0.01"),
        ("<cylinder radius=\"0.01\" length=\"NaN\"/>", "NaN"),
        ("<cylinder radius=\"19\" length=\"1\"/>", "19"),
        ("<capsule radius=\"0.01\" length=\"inf\"/>", "inf"),
    ] {
        refused(
            &edit(urdf, BOX_0, shape),
            &format!("link 'link_0.0': a collision shape's size of {value} must be above 0 and within 1 m"),
        );
    }
    let sphere = "<collision><geometry><sphere radius=\"0.01\"/></geometry></collision>";
    let many = |place: &str| edit(urdf, place, &format!("{place}{}", sphere.repeat(17)));
    refused(&many("<link name=\"palm_link\">"), "palm: 18 collision shapes are more than the 16 allowed");
    refused(&many("<link name=\"link_0.0\">"), "link 'link_0.0': its collision shapes make 19 capsules, more than");
}
