//! Values that change during a run: keys with a value each, in place of one value.

use serde::{Deserialize, Serialize};

use crate::math::Vec3;

use super::SceneError;
use super::fields::Value;

/// A value over time: linear between its keys, and constant before the first and after the last one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverTime<T> {
    /// Time in seconds and value, ascending; at least one.
    keys: Vec<(f64, T)>,
}

/// A value between two others.
pub trait Between: Copy {
    /// The value at `part` of the way to `end`, from 0 to 1.
    fn between(self, end: Self, part: f64) -> Self;
}

impl Between for f64 {
    fn between(self, end: f64, part: f64) -> f64 {
        self + (end - self) * part
    }
}

impl Between for Vec3 {
    fn between(self, end: Vec3, part: f64) -> Vec3 {
        let (start, end) = (self.as_dvec3(), end.as_dvec3());
        (start + (end - start) * part).as_vec3()
    }
}

impl<T: Between> OverTime<T> {
    /// A value with these keys, times in seconds; none if there are none or if they do not ascend.
    pub fn new(keys: Vec<(f64, T)>) -> Option<OverTime<T>> {
        let ascend = keys.windows(2).all(|pair| pair[0].0 < pair[1].0);
        (ascend && !keys.is_empty()).then_some(OverTime { keys })
    }

    /// The value at `time_s`.
    pub fn at(&self, time_s: f64) -> T {
        let after = self.keys.partition_point(|&(key_s, _)| key_s <= time_s);
        match (after.checked_sub(1).map(|before| self.keys[before]), self.keys.get(after)) {
            (Some((start_s, start)), Some(&(end_s, end))) => start.between(end, (time_s - start_s) / (end_s - start_s)),
            (Some((_, value)), None) | (None, Some(&(_, value))) => value,
            (None, None) => unreachable!("a value over time has a key"),
        }
    }

    /// Its values at the keys.
    pub fn values(&self) -> impl Iterator<Item = T> {
        self.keys.iter().map(|&(_, value)| value)
    }
}

/// Reads a value, or an array of `{ time_s, value }`. The value is that at time 0.
pub(super) fn over_time<'a, T: Between>(
    value: &Value<'a>,
    read: impl Fn(&Value<'a>) -> Result<T, SceneError>,
) -> Result<(T, Option<OverTime<T>>), SceneError> {
    let is_keyed = value.is_array() && value.array()?.first().is_some_and(Value::is_table);
    if !is_keyed {
        return Ok((read(value)?, None));
    }
    let mut keys: Vec<(f64, T)> = Vec::new();
    for key in value.array()? {
        let fields = key.table(&["time_s", "value"])?;
        let time_s = fields.required("time_s")?.number()?;
        if keys.last().is_some_and(|&(last_s, _)| last_s >= time_s) {
            return Err(fields.error_at("time_s", "must be later than that of the key before"));
        }
        keys.push((time_s, read(&fields.required("value")?)?));
    }
    let keyed = OverTime::new(keys).ok_or_else(|| value.error("needs a key"))?;
    Ok((keyed.at(0.0), Some(keyed)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_linear_between_keys_and_constant_outside() {
        let keyed = OverTime::new(vec![(1.0, 2.0), (3.0, 6.0), (3.5, 5.0)]).unwrap();
        for (time_s, value) in [(-1.0, 2.0), (1.0, 2.0), (2.0, 4.0), (3.0, 6.0), (3.25, 5.5), (3.5, 5.0), (9.0, 5.0)] {
            assert_eq!(keyed.at(time_s), value, "at {time_s} s");
        }
        let keyed = OverTime::new(vec![(0.0, Vec3::X), (2.0, Vec3::new(0.0, 0.0, -4.0))]).unwrap();
        assert_eq!(keyed.at(0.5), Vec3::new(0.75, 0.0, -1.0));
        assert_eq!(OverTime::<f64>::new(vec![]), None);
        assert_eq!(OverTime::new(vec![(1.0, 2.0), (1.0, 3.0)]), None);
    }
}
