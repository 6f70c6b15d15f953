//! The robot hand that a person's hand is tuned for.

use clap::ValueEnum;
use teleop_common::hand::HandModel;
use teleop_common::mapping::MappingParams;
use teleop_common::master::Calibration;

/// A robot hand known to the operator.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum RobotHand {
    /// The Allegro Hand V4; of the person's side, but its mirror image is tuned alike.
    #[default]
    AllegroV4,
    /// Another one: the robot's own parameters hold.
    None,
}

impl RobotHand {
    /// Works out the calibration's tuning for this hand, unless it is there already, and gives the reasons.
    pub fn tune(self, calibration: &mut Calibration) -> Vec<String> {
        match self {
            Self::AllegroV4 => {
                let tuned = calibration.tune(&HandModel::allegro_v4(calibration.side), &MappingParams::default());
                tuned.unwrap_or_else(|error| vec![format!("not tuned: {error}")])
            }
            Self::None => {
                calibration.tuning = None;
                Vec::new()
            }
        }
    }

    /// [`RobotHand::tune`] with the reasons in the log.
    pub(crate) fn tune_and_log(self, calibration: &mut Calibration) {
        for line in self.tune(calibration) {
            tracing::info!("{line}");
        }
    }
}
