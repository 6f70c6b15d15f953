//! The Allegro Hand V4, compiled in.

use super::{HandModel, HandSide};

/// URDF of the right Allegro Hand V4.
pub const ALLEGRO_V4_RIGHT_URDF: &str = include_str!("../../../urdf/allegro_v4_right.urdf");
/// Description of the right Allegro Hand V4.
pub const ALLEGRO_V4_RIGHT_DESCRIPTION: &str = include_str!("../../../urdf/allegro_v4_right.toml");
/// URDF of the left Allegro Hand V4.
pub const ALLEGRO_V4_LEFT_URDF: &str = include_str!("../../../urdf/allegro_v4_left.urdf");
/// Description of the left Allegro Hand V4.
pub const ALLEGRO_V4_LEFT_DESCRIPTION: &str = include_str!("../../../urdf/allegro_v4_left.toml");

/// URDF and description of the Allegro Hand V4 of one side, for replacing one of the two.
#[must_use]
pub const fn allegro_v4_texts(side: HandSide) -> (&'static str, &'static str) {
    match side {
        HandSide::Right => (ALLEGRO_V4_RIGHT_URDF, ALLEGRO_V4_RIGHT_DESCRIPTION),
        HandSide::Left => (ALLEGRO_V4_LEFT_URDF, ALLEGRO_V4_LEFT_DESCRIPTION),
    }
}

impl HandModel {
    /// The Allegro Hand V4 as compiled in.
    ///
    /// # Panics
    /// Never in a build whose tests pass: the two texts of either side are constants, and a test loads both.
    #[must_use]
    pub fn allegro_v4(side: HandSide) -> Self {
        let (urdf, description) = allegro_v4_texts(side);
        match Self::load(urdf, description) {
            Ok(hand) => hand,
            Err(error) => unreachable!("compiled-in {} hand: {error}", side.name()),
        }
    }
}
