//! The picture of both hands in a real browser.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use image::{Rgb, RgbImage};
use teleop_tests::eventually;
use teleop_tests::probe::Probe;
use teleop_tests::process::{Process, Robot, Signal};

/// An address of this machine on which no demo runs; the viewer's ports are fixed.
const HOST: &str = "127.0.0.2";
const SIZE: (u32, u32) = (1400, 900);

/// The fingers' colours, as hues in degrees: thumb, index, middle, ring, little.
const FINGERS: [(&str, f64); 5] =
    [("thumb", 39.0), ("index", 202.0), ("middle", 157.0), ("ring", 327.0), ("little", 56.0)];

/// Hue (degrees), saturation and value (0 to 1).
fn hsv(Rgb(pixel): &Rgb<u8>) -> (f64, f64, f64) {
    let [r, g, b] = pixel.map(|channel| f64::from(channel) / 255.0);
    let (high, low) = (r.max(g).max(b), r.min(g).min(b));
    let span = high - low;
    let sector = if span == 0.0 {
        0.0
    } else if high == r {
        ((g - b) / span).rem_euclid(6.0)
    } else if high == g {
        (b - r) / span + 2.0
    } else {
        (r - g) / span + 4.0
    };
    (60.0 * sector, if high > 0.0 { span / high } else { 0.0 }, high)
}

/// A part of the picture, in fractions of its width and height.
struct Part {
    x: (f64, f64),
    y: (f64, f64),
}

impl Part {
    fn count(&self, picture: &RgbImage, wanted: impl Fn(f64, f64, f64) -> bool) -> usize {
        let span = |(from, to): (f64, f64), size: u32| {
            (from * f64::from(size)) as u32..((to * f64::from(size)) as u32).min(size)
        };
        let rows = span(self.y, picture.height());
        let pixels = rows.flat_map(|y| span(self.x, picture.width()).map(move |x| (x, y)));
        pixels
            .filter(|&(x, y)| {
                let (hue, saturation, value) = hsv(picture.get_pixel(x, y));
                wanted(hue, saturation, value)
            })
            .count()
    }

    fn of_hue(&self, picture: &RgbImage, wanted: f64) -> usize {
        self.count(picture, |hue, saturation, value| {
            let apart = (hue - wanted).abs();
            apart.min(360.0 - apart) < 8.0 && saturation > 0.35 && value > 0.3
        })
    }
}

/// What is missing in the picture: nothing, if both hands are in it.
fn missing(picture: &RgbImage) -> Vec<String> {
    // The two 3D views: side by side in the upper left of the page.
    let human = Part { x: (0.01, 0.27), y: (0.08, 0.60) };
    let robot = Part { x: (0.29, 0.55), y: (0.08, 0.60) };
    let mut missing = Vec::new();
    for (finger, hue) in FINGERS {
        let pixels = human.of_hue(picture, hue);
        print!("human {finger} {pixels}, ");
        if pixels < 250 {
            missing.push(format!("the human {finger}: {pixels} pixels"));
        }
    }
    // The robot's fingertips are in the colours of its fingers, the rest is grey.
    for (finger, hue) in &FINGERS[..4] {
        let pixels = robot.of_hue(picture, *hue);
        print!("robot {finger} {pixels}, ");
        if pixels < 60 {
            missing.push(format!("the robot's {finger}: {pixels} pixels"));
        }
    }
    // The background is dark too, but blueish.
    let grey = robot.count(picture, |_, saturation, value| saturation < 0.12 && (0.05..0.5).contains(&value));
    println!("robot grey {grey}");
    if grey < 5000 {
        missing.push(format!("the robot's palm and links: {grey} pixels"));
    }
    missing
}

/// Where a browser is missing the test is skipped, unless it must not be.
fn has_browser() -> bool {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&paths).any(|folder| names.iter().any(|name| folder.join(name).is_file()));
    if !found {
        let required = std::env::var_os("TELEOP_REQUIRE_BROWSER").is_some_and(|value| value == "1");
        assert!(!required, "TELEOP_REQUIRE_BROWSER=1, but there is none of {names:?} in PATH");
        println!("skipped: needs one of {names:?}");
    }
    found
}

#[test]
fn both_hands_are_in_the_browser() {
    if !has_browser() {
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let taken = |port: u16| TcpStream::connect((HOST, port)).is_ok();
    assert!(!taken(9090) && !taken(9876), "another viewer runs on {HOST}");
    let web = format!("web={HOST}");
    let mut robot = Robot::start(&["--viewer", &web]);
    let mut page = String::new();
    eventually("the robot tells the address of the page", || {
        let log = robot.process.stderr();
        let word = log.split_whitespace().find(|word| word.starts_with("http://"));
        page = word.unwrap_or_default().to_owned();
        !page.is_empty()
    });
    assert!(page.starts_with(&format!("http://{HOST}:9090/")), "{page}");
    let probe = Probe::connect(robot.endpoint());
    let connect = robot.endpoint().to_owned();
    let arguments = ["run", "--viewer", &web, "--connect", &connect, "--source", "tour"];
    let mut operator = Process::start("operator", &arguments);
    probe.wait_for_motion(0.2);

    // How long software rendering takes to show the first picture depends on the machine.
    // target/release/deps/viewer-* is this program.
    let program = std::env::current_exe().unwrap();
    let picture = program.ancestors().nth(3).unwrap().join("viewer.png");
    let size = format!("{}x{}", SIZE.0, SIZE.1);
    let mut lacking = Vec::new();
    for after in ["10", "20", "40"] {
        let mut camera = Command::new(root.join("deploy/screenshot"));
        camera.args([&page, "--quiet", "--after", after, "--size", &size]).arg(&picture);
        assert!(camera.status().unwrap().success(), "no picture of {page}");
        let pixels = image::open(&picture).unwrap().to_rgb8();
        assert_eq!(pixels.dimensions(), SIZE);
        lacking = missing(&pixels);
        if lacking.is_empty() {
            break;
        }
    }
    assert!(lacking.is_empty(), "not in {}: {}", picture.display(), lacking.join(", "));
    println!("both hands are in {}", picture.display());

    operator.stop(Signal::Term);
    robot.process.stop(Signal::Term);
    assert!(!taken(9090) && !taken(9876), "the viewer's ports are still taken");
}
