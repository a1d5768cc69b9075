//! The local origin of a scene or a mesh file: the point about which positions are held in f32.

use super::DVec3;

/// Up to this distance from the world's origin, meters, positions are held as they are: f32 rounds them by at most 4
/// micrometers there.
pub const FAR_M: f64 = 100.0;

/// Local origins are multiples of this, so that subtracting them from coordinates in f64 is exact for all inputs that
/// people write. Round distances such as 1 km are multiples, too.
const GRID: f64 = 8.0;

/// The local origin for points in the box from `low` to `high`. A coordinate of it is zero if the box stays within
/// `far` on that axis. Otherwise it is the multiple of `GRID` next to the middle of the box. `far` has the unit of
/// the box.
pub fn local_origin(low: DVec3, high: DVec3, far: f64) -> DVec3 {
    let axis = |low: f64, high: f64| {
        let is_near = low >= -far && high <= far;
        if is_near { 0.0 } else { (0.5 * (low + high) / GRID).round() * GRID }
    };
    DVec3::new(axis(low.x, high.x), axis(low.y, high.y), axis(low.z, high.z))
}

/// The smallest box that holds the points: its lower and its upper corner.
pub fn bounds(points: impl IntoIterator<Item = DVec3>) -> (DVec3, DVec3) {
    let empty = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    points.into_iter().fold(empty, |(low, high), p| (low.min(p), high.max(p)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_on_every_axis_that_stays_near_and_next_to_the_middle_on_others() {
        let origin = |low: [f64; 3], high: [f64; 3]| local_origin(low.into(), high.into(), FAR_M).to_array();
        assert_eq!(origin([-100.0, 0.0, 99.0], [100.0, 1.0, 100.0]), [0.0; 3]);
        assert_eq!(origin([9999.5, 0.35, -10000.5], [10000.5, 0.35, -9999.5]), [10000.0, 0.0, -10000.0]);
        assert_eq!(origin([-3.0, 100.0, 0.0], [3.0, 105.0, 100.1]), [0.0, 104.0, 48.0]);
        assert_eq!(local_origin(DVec3::splat(9990.0), DVec3::splat(10010.0), 1e4), DVec3::splat(10000.0));
    }

    #[test]
    fn bounds_of_points() {
        let points = [DVec3::new(1.0, 5.0, -1.0), DVec3::new(2.0, -5.0, 0.0)];
        assert_eq!(bounds(points), (DVec3::new(1.0, -5.0, -1.0), DVec3::new(2.0, 5.0, 0.0)));
    }
}
