//! The link model does what its figures say, in virtual time.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use teleop_link::{Blackouts, Cause, Direction, Fate, Impairment, Link, LinkModel, Profile, Shape};

const MS: Duration = Duration::from_millis(1);
const PACKETS: usize = 200_000;

fn model(impairment: Impairment, seed: u64) -> LinkModel {
    LinkModel::new(impairment, Blackouts::default(), seed, Direction::Up)
}

/// Sends `PACKETS` of 100 bytes, one every `period`.
fn fates(impairment: Impairment, period: Duration) -> Vec<Fate> {
    let mut model = model(impairment, 7);
    (0..PACKETS as u32).map(|number| model.send(period * number, 100)).collect()
}

fn share(fates: &[Fate], test: impl Fn(&Fate) -> bool) -> f64 {
    fates.iter().filter(|fate| test(fate)).count() as f64 / fates.len() as f64
}

fn lost(fate: &Fate) -> bool {
    *fate == Fate::Lost(Cause::Chance)
}

/// One-way delays of what arrives, in ms.
fn delays(fates: &[Fate], period: Duration) -> Vec<f64> {
    let delay = |(number, fate): (usize, &Fate)| match fate {
        Fate::Arrives { at, .. } => Some((*at - period * number as u32).as_secs_f64() * 1e3),
        Fate::Lost(_) => None,
    };
    fates.iter().enumerate().filter_map(delay).collect()
}

fn quantile(delays: &[f64], share: f64) -> f64 {
    let mut sorted = delays.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[(share * (sorted.len() - 1) as f64) as usize]
}

/// Correlation of each number with the one after it.
fn correlation(numbers: &[f64]) -> f64 {
    let mean = numbers.iter().sum::<f64>() / numbers.len() as f64;
    let variance: f64 = numbers.iter().map(|x| (x - mean).powi(2)).sum();
    numbers.windows(2).map(|pair| (pair[0] - mean) * (pair[1] - mean)).sum::<f64>() / variance
}

#[track_caller]
fn close(what: &str, value: f64, expected: f64, tolerance: f64) {
    println!("{what}: {value:.4}, expected {expected} +- {tolerance}");
    assert!((value - expected).abs() <= tolerance, "{what}: {value}, expected {expected} +- {tolerance}");
}

#[test]
fn the_default_does_nothing() {
    let mut model = model(Impairment::default(), 1);
    for number in 0..1000 {
        let now = MS * number;
        assert_eq!(model.send(now, 60_000), Fate::Arrives { at: now, copy: None });
        assert_eq!((model.send_segment(now, 1448).at, model.room(now, 1 << 20)), (now, Duration::ZERO));
    }
}

#[test]
fn the_same_seed_gives_the_same_link() {
    for profile in Profile::ALL {
        let run = |seed| {
            let [mut up, mut down] = profile.link().models(seed);
            let send = |number: u32| [up.send(MS * number, 200), down.send(MS * number, 300)];
            (0..20_000).map(send).collect::<Vec<_>>()
        };
        let (one, same, other) = (run(3), run(3), run(4));
        assert_eq!(one, same, "{}", profile.name);
        if profile.link() != Link::default() {
            assert_ne!(one, other, "{}", profile.name);
            let [ups, downs] = [0, 1].map(|way| one.iter().map(|fates| fates[way]).collect::<Vec<_>>());
            assert_ne!(ups, downs, "{}", profile.name);
        }
    }
}

#[test]
fn chance_does_not_depend_on_time_nor_on_other_figures() {
    let figures = Impairment { loss: 0.1, burst: Some(3.0), reorder: 0.1, duplicate: 0.1, ..Impairment::default() };
    let fate = |fate: &Fate| (lost(fate), matches!(fate, Fate::Arrives { copy: Some(_), .. }));
    let slowly: Vec<_> = fates(figures, 10 * MS).iter().map(fate).collect();
    let quickly: Vec<_> = fates(figures, MS / 100).iter().map(fate).collect();
    let jittery = Impairment { delay: 50 * MS, jitter: 20 * MS, reorder: 0.5, ..figures };
    let otherwise: Vec<_> = fates(jittery, MS).iter().map(fate).collect();
    assert!(slowly == quickly && slowly == otherwise);

    // Packets that a blackout took still took their rolls.
    let mut dark = LinkModel::new(figures, "0..1".parse().unwrap(), 7, Direction::Up);
    let mixed: Vec<_> = (0..PACKETS as u32).map(|number| dark.send(MS * number, 100)).collect();
    assert!(mixed[..1000].iter().all(|fate| *fate == Fate::Lost(Cause::Blackout)));
    assert!(mixed[1000..].iter().map(fate).eq(slowly[1000..].iter().copied()));
}

#[test]
fn loss_is_independent_or_in_bursts() {
    for (loss, burst) in
        [(0.01, None), (0.3, None), (0.01, Some(1.0)), (0.02, Some(5.0)), (0.3, Some(4.0)), (0.5, Some(1.0))]
    {
        let fates = fates(Impairment { loss, burst, ..Impairment::default() }, MS);
        let mean_burst = {
            let bursts = fates.windows(2).filter(|pair| !lost(&pair[0]) && lost(&pair[1])).count();
            share(&fates, lost) * PACKETS as f64 / bursts as f64
        };
        let expected = burst.unwrap_or(1.0 / (1.0 - loss));
        // Deviation of a share of bursts: about sqrt(2 burst loss / packets).
        let deviation = (2.0 * expected * loss / PACKETS as f64).sqrt();
        close(&format!("loss {loss} {burst:?}"), share(&fates, lost), loss, 4.5 * deviation);
        close(&format!("burst {loss} {burst:?}"), mean_burst, expected, 0.06 * expected);
    }
    assert_eq!(share(&fates(Impairment { loss: 1.0, burst: Some(3.0), ..Impairment::default() }, MS), lost), 1.0);
}

#[test]
fn delays_follow_their_distribution() {
    let jitter = |shape, jitter_correlation| Impairment {
        delay: 50 * MS,
        jitter: 10 * MS,
        shape,
        jitter_correlation,
        ..Impairment::default()
    };
    // So far apart that no packet waits for the one in front.
    let period = 1000 * MS;
    for rho in [0.0, 0.8] {
        let wide = if rho > 0.0 { 3.0 } else { 1.0 };
        let uniform = delays(&fates(jitter(Shape::Uniform, rho), period), period);
        for share in [0.01, 0.25, 0.5, 0.75, 0.99] {
            close("uniform", quantile(&uniform, share), 40.0 + 20.0 * share, 0.15 * wide);
        }
        assert!(uniform.iter().all(|delay| (40.0..=60.0).contains(delay)));

        let normal = delays(&fates(jitter(Shape::Normal, rho), period), period);
        for (share, z) in [(0.022_75, -2.0), (0.158_66, -1.0), (0.5, 0.0), (0.841_34, 1.0), (0.977_25, 2.0)] {
            close("normal", quantile(&normal, share), 50.0 + 10.0 * z, 0.25 * wide);
        }
        assert!(normal.iter().all(|delay| (20.0..=80.0).contains(delay)));

        let pareto = delays(&fates(jitter(Shape::Pareto, rho), period), period);
        for share in [0.1, 0.5, 0.9, 0.99] {
            let expected = 50.0 + 15.0 * ((1.0_f64 - share).powf(-0.4) - 1.0);
            close("pareto", quantile(&pareto, share), expected, 0.02 * wide * (expected - 40.0));
        }
        let mean = pareto.iter().sum::<f64>() / pareto.len() as f64;
        close("pareto mean", mean, 60.0, 0.5 * wide);
        assert!(pareto.iter().all(|delay| (50.0..=250.0).contains(delay)));

        close("correlation", correlation(&normal), rho, 0.02);
    }
    let constant = fates(Impairment { delay: 50 * MS, ..Impairment::default() }, MS);
    assert!(delays(&constant, MS).iter().all(|delay| (delay - 50.0).abs() < 1e-9));
}

#[test]
fn jitter_alone_never_reorders_and_no_delay_is_negative() {
    for shape in [Shape::Uniform, Shape::Normal, Shape::Pareto] {
        let fates = fates(Impairment { delay: 5 * MS, jitter: 20 * MS, shape, ..Impairment::default() }, MS);
        let arrivals: Vec<_> = fates
            .iter()
            .map(|fate| match fate {
                Fate::Arrives { at, .. } => *at,
                Fate::Lost(_) => panic!("lost"),
            })
            .collect();
        assert!(arrivals.is_sorted());
        assert!(arrivals.iter().enumerate().all(|(number, at)| *at >= MS * number as u32));
    }
}

#[test]
fn reordered_are_as_many_as_asked_for_and_late_by_as_much() {
    let figures = Impairment { delay: 10 * MS, reorder: 0.05, reorder_by: 30 * MS, ..Impairment::default() };
    let fates = fates(figures, 5 * MS);
    let delays = delays(&fates, 5 * MS);
    assert!(delays.iter().all(|delay| (delay - 10.0).abs() < 1e-9 || (delay - 40.0).abs() < 1e-9));
    let late = delays.iter().filter(|delay| **delay > 39.0).count() as f64 / PACKETS as f64;
    close("reordered", late, 0.05, 0.003);
}

#[test]
fn copies_are_as_many_as_asked_for_and_no_sooner() {
    let figures = Impairment { delay: 10 * MS, jitter: 5 * MS, duplicate: 0.2, loss: 0.1, ..Impairment::default() };
    let fates = fates(figures, 100 * MS);
    close("copies", share(&fates, |fate| matches!(fate, Fate::Arrives { copy: Some(_), .. })), 0.18, 0.005);
    let copies = fates.iter().filter_map(|fate| match fate {
        Fate::Arrives { at, copy: Some(copy) } => Some((*at, *copy)),
        _ => None,
    });
    let (mut later, mut all) = (0, 0);
    for (at, copy) in copies {
        assert!(copy >= at && copy <= at + 10 * MS);
        later += u32::from(copy > at);
        all += 1;
    }
    close("later copies", f64::from(later) / f64::from(all), 0.5, 0.02);
}

#[test]
fn rate_limits_and_the_queue_is_bounded() {
    // 1 Mbit/s: 100 bytes take 0.8 ms. A packet each 0.4 ms is twice too much.
    let figures = Impairment { delay: 10 * MS, rate: Some(1e6), queue: 10_000, ..Impairment::default() };
    let period = Duration::from_micros(400);
    let fates = fates(figures, period);
    let dropped = share(&fates, |fate| *fate == Fate::Lost(Cause::Queue));
    close("dropped", dropped, 0.5, 0.001);
    let delays = delays(&fates, period);
    // A full queue of 10 kB is 80 ms.
    close("longest", delays.iter().copied().fold(0.0, f64::max), 90.0, 0.01);
    close("shortest", delays.iter().copied().fold(1e9, f64::min), 10.8, 0.01);
    let time = period * PACKETS as u32;
    let rate = delays.len() as f64 * 800.0 / time.as_secs_f64();
    close("rate", rate, 1e6, 2e3);

    // Below its rate the line delays by the packet's own time only, and drops nothing; a giant passes an idle line.
    let mut model = model(figures, 1);
    for number in 0..1000_u32 {
        let now = MS * number;
        assert_eq!(model.send(now, 100), Fate::Arrives { at: now + Duration::from_micros(10_800), copy: None });
    }
    let later = 2000 * MS;
    assert_eq!(model.send(later, 60_000), Fate::Arrives { at: later + 490 * MS, copy: None });
    assert_eq!(model.send(later, 100), Fate::Lost(Cause::Queue));
    assert_eq!(model.room(later, 100), 480 * MS - Duration::from_micros(79_200));
}

#[test]
fn blackouts_take_what_is_sent_in_them() {
    let mut model = LinkModel::new(
        Impairment { delay: 50 * MS, ..Impairment::default() },
        "every 1 for 0.1".parse().unwrap(),
        1,
        Direction::Up,
    );
    for number in 0..10_000_u32 {
        let now = MS * number;
        let dark = number >= 1000 && number % 1000 < 100;
        let expected = if dark { Fate::Lost(Cause::Blackout) } else { Fate::Arrives { at: now + 50 * MS, copy: None } };
        assert_eq!(model.send(now, 100), expected, "{number} ms");
    }
    let now = 10_500 * MS;
    model.blackout(true);
    assert!(model.dark(now) && model.send(now, 100) == Fate::Lost(Cause::Blackout));
    model.blackout(false);
    assert!(!model.dark(now) && model.send(now, 100) != Fate::Lost(Cause::Blackout));
}

#[test]
fn segments_come_late_instead_of_never() {
    let figures = Impairment { delay: 50 * MS, loss: 0.1, ..Impairment::default() };
    let mut model = model(figures, 5);
    let period = 10_000 * MS;
    let mut count = [0_u32; 8];
    for number in 0..PACKETS as u32 {
        let now = period * number;
        let segment = model.send_segment(now, 1448);
        // A round trip and 200 ms, then twice as long each time.
        let waits = (1 << segment.losses.min(5)) - 1;
        if segment.losses < 5 {
            assert_eq!(segment.at, now + 50 * MS + 300 * MS * waits, "{} losses", segment.losses);
        }
        count[segment.losses as usize] += 1;
    }
    let share = |losses: usize| f64::from(count[losses]) / PACKETS as f64;
    close("lost once", share(1), 0.09, 0.004);
    close("lost twice", share(2), 0.009, 0.0015);

    // Lost for good is nothing, even on a link that loses all.
    let mut dead = self::model(Impairment { loss: 1.0, ..Impairment::default() }, 1);
    assert_eq!(dead.send_segment(Duration::ZERO, 1).losses, 6);

    // Those of a blackout wait for its end, and so do those that would arrive in it.
    let mut dark = LinkModel::new(
        Impairment { delay: 50 * MS, ..Impairment::default() },
        "1..2".parse().unwrap(),
        1,
        Direction::Up,
    );
    for (sent, arrives) in [(900, 950), (960, 2000), (1500, 2050), (2500, 2550)] {
        assert_eq!(dark.send_segment(MS * sent, 100).at, MS * arrives, "sent at {sent} ms");
    }
}

#[test]
fn impossible_figures_are_refused_and_do_no_harm() {
    let base = Impairment::default();
    let wrong = [
        Impairment { delay: Duration::MAX, ..base },
        Impairment { jitter: Duration::from_secs(61), ..base },
        Impairment { loss: f64::NAN, ..base },
        Impairment { loss: -0.1, ..base },
        Impairment { loss: 0.8, burst: Some(2.0), ..base },
        Impairment { burst: Some(0.5), ..base },
        Impairment { reorder: 2.0, reorder_by: Duration::MAX, ..base },
        Impairment { duplicate: f64::INFINITY, ..base },
        Impairment { jitter: MS, jitter_correlation: f64::NAN, ..base },
        Impairment { jitter: MS, jitter_correlation: -3.0, ..base },
        Impairment { rate: Some(0.0), ..base },
        Impairment { rate: Some(f64::NAN), ..base },
        Impairment { rate: Some(1e6), queue: 0, ..base },
    ];
    for impairment in wrong {
        let error = impairment.check().unwrap_err().to_string();
        assert!(error.contains("must be"), "{error}");
        let mut model = model(impairment, 1);
        for number in 0..1000 {
            let now = MS * number;
            if let Fate::Arrives { at, .. } = model.send(now, 65_507) {
                assert!(at >= now);
            }
            assert!(model.send_segment(now, 1448).at >= now);
        }
    }
}
