//! What a contact step refuses when it is made: bodies that do not exist, numbers out of range.

use delmpc_mechanics::tree::KinematicTree;

use super::{ContactOptions, ContactPoint, GroundGive};
use crate::contact_law::Regularisation;
use crate::error::{PlantError, require};

pub(super) fn check(
    tree: &KinematicTree,
    contacts: &[ContactPoint],
    options: &ContactOptions,
) -> Result<(), PlantError> {
    for contact in contacts {
        if contact.body >= tree.body_count() {
            let (got, expected) = (contact.body, tree.body_count());
            return Err(PlantError::Shape { quantity: "body of a contact point", got, expected });
        }
        check_friction(contact.friction)?;
        for value in contact.point.iter() {
            require(value.is_finite(), "a contact point", *value, "finite")?;
        }
    }
    let Regularisation { strength, forgetting } = options.regularisation;
    let share = |x: f64| (0.0..=1.0).contains(&x);
    require(
        options.correction > 0.0 && share(options.correction),
        "correction",
        options.correction,
        "in (0, 1]",
    )?;
    require(share(strength), "regularisation", strength, "in [0, 1]")?;
    require(share(forgetting), "forgetting", forgetting, "in [0, 1]")?;
    require(options.tolerance > 0.0 && options.tolerance < 1.0, "tolerance", options.tolerance, "in (0, 1)")?;
    let GroundGive { stiffness, damping } = options.ground;
    require(stiffness > 0.0, "stiffness of the ground", stiffness, "positive (infinite for rigid)")?;
    require(
        damping.is_finite() && damping >= 0.0,
        "damping of the ground",
        damping,
        "finite and not negative",
    )?;
    require(options.max_rounds > 0, "rounds", options.max_rounds as f64, "at least 1")?;
    require(options.max_candidates <= 64, "candidates", options.max_candidates as f64, "at most 64")
}

pub(super) fn check_friction(friction: f64) -> Result<(), PlantError> {
    require(
        friction.is_finite() && friction >= 0.0,
        "friction coefficient",
        friction,
        "finite and not negative",
    )
}
