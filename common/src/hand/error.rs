/// Why a URDF or a hand description was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandError {
    /// The URDF is not XML, or not a URDF.
    #[error("urdf: {0}")]
    UrdfSyntax(String),
    /// An element of the URDF is missing, contradictory or not supported.
    #[error("urdf: {element}: {problem}")]
    Urdf {
        /// Kind and name of the element, for example `joint 'joint_3.0'`.
        element: String,
        /// What is wrong and how to mend it.
        problem: String,
    },
    /// The description is not TOML, or has unknown or missing keys.
    #[error("description: {0}")]
    DescriptionSyntax(String),
    /// An entry of the description is wrong or contradicts the URDF.
    #[error("description: {entry}: {problem}")]
    Description {
        /// The entry, for example `joints.home`.
        entry: String,
        /// What is wrong and how to mend it.
        problem: String,
    },
}

impl HandError {
    pub(super) fn urdf(element: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Urdf { element: element.into(), problem: problem.into() }
    }

    pub(super) fn description(entry: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Description { entry: entry.into(), problem: problem.into() }
    }
}
