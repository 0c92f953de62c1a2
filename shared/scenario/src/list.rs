//! A key that holds one table or a list of tables.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::PushSettings;

#[derive(Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    Many(Vec<PushSettings>),
    One(PushSettings),
}

/// Reads `[push]` as a list of one.
pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<PushSettings>, D::Error> {
    Ok(match OneOrMany::deserialize(from)? {
        OneOrMany::Many(list) => list,
        OneOrMany::One(push) => vec![push],
    })
}

/// Writes a list of one as `[push]`.
pub(crate) fn serialize<S: Serializer>(list: &[PushSettings], to: S) -> Result<S::Ok, S::Error> {
    match list {
        [one] => one.serialize(to),
        many => many.serialize(to),
    }
}
