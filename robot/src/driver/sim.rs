use std::time::Duration;

use teleop_common::hand::{HandModel, JointVector};

use super::{DriverError, HandDriver, JointCommand, JointState, Pace};

/// Inertia seen by a joint, kg m². No source gives the Allegro's reflected inertia; this makes the gains of its
/// public controllers (1 N m/rad, 0.04 N m s/rad) critically damped, which is how those controllers behave.
const INERTIA: f64 = 4e-4;
/// Viscous friction, N m s/rad.
const VISCOUS: f64 = 2e-3;
/// Coulomb friction, N m.
const COULOMB: f64 = 0.01;
/// Integration steps per tick.
const SUBSTEPS: u32 = 8;

/// A simulated hand: independent second-order joints with friction and hard stops, driven by torque. No contact.
///
/// It advances by exactly one period per [`HandDriver::read`], so the same commands give the same motion on any
/// machine, and in virtual time.
#[derive(Clone, Debug)]
pub struct SimHand {
    limits: Vec<(f64, f64)>,
    torque_limit: Vec<f64>,
    period: f64,
    state: JointState,
    torque: JointVector,
    started: bool,
}

impl SimHand {
    /// A hand at its home posture that advances by `period` seconds per read.
    #[must_use]
    pub fn new(hand: &HandModel, period: f64) -> Self {
        let zero = JointVector::zeros(hand.joints.len());
        Self {
            limits: hand.joints.iter().map(|joint| (joint.lower, joint.upper)).collect(),
            torque_limit: hand.joints.iter().map(|joint| joint.torque).collect(),
            period,
            state: JointState { q: hand.home(), dq: zero, tau: zero },
            torque: zero,
            started: false,
        }
    }

    fn advance(&mut self) {
        let step = self.period / f64::from(SUBSTEPS);
        for (joint, &(lower, upper)) in self.limits.iter().enumerate() {
            let (mut q, mut dq, torque) = (self.state.q[joint], self.state.dq[joint], self.torque[joint]);
            for _ in 0..SUBSTEPS {
                // Velocity first (semi-implicit), viscous friction implicitly: stable for any gain in use.
                let driven = (dq + torque / INERTIA * step) / (1.0 + VISCOUS / INERTIA * step);
                // Coulomb friction takes away speed but never turns it round.
                let lost = COULOMB / INERTIA * step;
                dq = driven.signum() * (driven.abs() - lost).max(0.0);
                q += dq * step;
                if q < lower || q > upper {
                    q = q.clamp(lower, upper);
                    dq = 0.0;
                }
            }
            (self.state.q[joint], self.state.dq[joint], self.state.tau[joint]) = (q, dq, torque);
        }
    }
}

impl HandDriver for SimHand {
    fn name(&self) -> &'static str {
        "simulated hand"
    }

    fn pace(&self) -> Pace {
        Pace::Loop
    }

    fn start(&mut self) -> Result<(), DriverError> {
        self.torque = JointVector::zeros(self.limits.len());
        self.started = true;
        Ok(())
    }

    fn read(&mut self, _timeout: Duration) -> Result<JointState, DriverError> {
        if !self.started {
            return Err(DriverError::NotStarted);
        }
        self.advance();
        Ok(self.state)
    }

    fn write(&mut self, command: &JointCommand) -> Result<(), DriverError> {
        if !self.started {
            return Err(DriverError::NotStarted);
        }
        for (joint, &limit) in self.torque_limit.iter().enumerate() {
            let torque = command.tau.get(joint).copied().filter(|torque| torque.is_finite()).unwrap_or(0.0);
            self.torque[joint] = torque.clamp(-limit, limit);
        }
        Ok(())
    }

    fn stop(&mut self) {
        self.torque = JointVector::zeros(self.limits.len());
        self.started = false;
    }
}
