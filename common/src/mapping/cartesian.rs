use nalgebra::Vector3;

use super::Tuning;
use super::contact::{Contact, KNEE};
use crate::hand::{Finger, HandModel, MAX_FINGERS};
use crate::master::MasterGeometry;

/// The Cartesian mapping of the thumb (Eq. 10-12) and of the fingers relative to it (Eq. 9).
///
/// Points are in O_W (master) and O_SW (slave), m. The finger base frames O_i and O_Si are translated copies of O_W
/// and O_SW: with the Allegro's 5 degree toe-out in them, Eq. 10 would jump at the index and ring bases.
#[derive(Clone, Debug)]
pub struct CartesianMap {
    // c_s of the thumb's map and of the fingers' vectors.
    scale: [f64; MAX_FINGERS],
    contact: [Contact; MAX_FINGERS],
    // (finger, o_Si), radial to ulnar, without the thumb.
    bases: [(Finger, Vector3<f64>); MAX_FINGERS],
    count: usize,
}

impl CartesianMap {
    /// The mapping onto `hand` with scale c_s, of an exact model of the master's hand.
    #[must_use]
    pub fn new(hand: &HandModel, scale: f64) -> Self {
        let mut bases = [(Finger::Index, Vector3::zeros()); MAX_FINGERS];
        let fingers = hand.fingers.iter().filter(|chain| chain.finger != Finger::Thumb).take(MAX_FINGERS);
        let mut count = 0;
        for (slot, chain) in bases.iter_mut().zip(fingers) {
            *slot = (chain.finger, chain.base);
            count += 1;
        }
        let contact = [Contact { touch: 0.0, release: 0.0 }; MAX_FINGERS];
        Self { scale: [scale; MAX_FINGERS], contact, bases, count }
    }

    /// Takes scales and contact distances from `tuning`.
    pub fn tune(&mut self, tuning: &Tuning) {
        self.scale = tuning.scale;
        self.contact = tuning.contact.map(|touch| Contact { touch, release: tuning.r2 });
    }

    /// p_C,T: target of the slave's thumb tip in O_SW for the master's in O_W (Eq. 10-12), or for its [`Self::meeting`].
    ///
    /// The radial coordinate is scaled by c_s outside the span of the finger bases and interpolated between them
    /// inside, which makes it continuous and monotone; the others are scaled about the first finger's base. Below
    /// the last finger that the slave has, c_s takes over again (the Allegro has no little finger).
    #[must_use]
    pub fn thumb(&self, geometry: &MasterGeometry, tip: &Vector3<f64>) -> Vector3<f64> {
        let bases = &self.bases[..self.count];
        let Some(&(first, first_slave)) = bases.first() else {
            return tip * self.scale[Finger::Thumb.index()];
        };
        let origin = Vector3::from(geometry.bases[first.index()]);
        let mut target = first_slave + (tip - origin) * self.scale[Finger::Thumb.index()];
        target.x = self.radial(geometry, tip.x);
        target
    }

    /// Where the master's thumb tip would be if the keypoints of touching tips coincided, for its tips (O_W, m): moved
    /// half of what [`Contact`] takes out towards the closest finger, and towards the mean where several are as close.
    ///
    /// Thumb and finger then go half of the way each; with all of it left to the finger, the place of contact would be
    /// off by that half, and often out of reach.
    #[must_use]
    pub fn meeting(&self, tips: &[Vector3<f64>; MAX_FINGERS]) -> Vector3<f64> {
        let thumb = tips[Finger::Thumb.index()];
        if self.contact.iter().all(|contact| contact.touch <= 0.0) {
            return thumb;
        }
        let fingers = self.bases[..self.count].iter().map(|(finger, _)| {
            let contact = &self.contact[finger.index()];
            let vector = tips[finger.index()] - thumb;
            (vector.norm() - contact.touch, vector - contact.relative(&vector))
        });
        let closest = fingers.clone().map(|(beyond, _)| beyond).fold(f64::INFINITY, f64::min);
        // A smooth choice of the closest: twice as far beyond its touch as the tracker's noise, a finger counts an eighth.
        let (weight, sum) = fingers.fold((0.0, Vector3::zeros()), |(weight, sum), (beyond, removed)| {
            let own = ((closest - beyond) / KNEE).exp();
            (weight + own, sum + removed * own)
        });
        // Never empty, and the closest weighs 1.
        if weight > 0.0 { thumb + sum * (0.5 / weight) } else { thumb }
    }

    /// x_S(x), Eq. 10.
    fn radial(&self, geometry: &MasterGeometry, x: f64) -> f64 {
        let scale = self.scale[Finger::Thumb.index()];
        let base = |finger: Finger| geometry.bases[finger.index()][0];
        let bases = &self.bases[..self.count];
        let (Some(&(first, first_slave)), Some(&(last, last_slave))) = (bases.first(), bases.last()) else {
            return x * scale;
        };
        if x >= base(first) {
            return first_slave.x + scale * (x - base(first));
        }
        for pair in bases.windows(2) {
            let ((from, from_slave), (to, to_slave)) = (pair[0], pair[1]);
            if x >= base(to) {
                // d_{l,t}: ratio of the spacings of the finger bases.
                let ratio = (from_slave.x - to_slave.x) / (base(from) - base(to));
                return from_slave.x + ratio * (x - base(from));
            }
        }
        last_slave.x + scale * (x - base(last))
    }

    /// p_C,j: target of a slave fingertip in O_SW, hanging on the slave's thumb at `anchor` (Eq. 9, the vector from the
    /// thumb shortened by [`Contact`]).
    #[must_use]
    pub fn finger(
        &self,
        finger: Finger,
        tip: &Vector3<f64>,
        thumb: &Vector3<f64>,
        anchor: &Vector3<f64>,
    ) -> Vector3<f64> {
        let finger = finger.index();
        anchor + self.contact[finger].relative(&(tip - thumb)) * self.scale[finger]
    }
}
