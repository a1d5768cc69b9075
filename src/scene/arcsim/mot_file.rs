//! ARCSim's `.mot` files: positions and orientations of rigid bodies, frame by frame.
//!
//! Layout: a line with a label and the number n of frames. Then for every body a heading, n lines `x y z`, a heading,
//! and n lines of a quaternion, scalar first. Blank lines can precede headings. ARCSim does not rely on more than this.

use crate::math::{DQuat, DVec3};

/// Placement of a body in one frame: x -> orientation * x + position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BodyFrame {
    pub position: DVec3,
    pub orientation: DQuat,
}

/// The frames of every body. An error names the line.
pub(super) fn parse(text: &str) -> Result<Vec<Vec<BodyFrame>>, String> {
    let mut lines = text.lines().zip(1..);
    let (first, _) = lines.next().ok_or("it is empty")?;
    let frames = first.split_whitespace().nth(1).and_then(|count| count.parse::<usize>().ok());
    let frames = frames.filter(|&frames| frames > 0 && frames <= text.len());
    let frames = frames.ok_or_else(|| "line 1 must be `NumFrames: n` with n of at least 1".to_owned())?;
    let mut bodies = Vec::new();
    loop {
        // The text of the heading is ignored, because the order is fixed.
        if lines.by_ref().all(|(line, _)| line.trim().is_empty()) {
            break;
        }
        let mut numbers = |what: &str, count: usize| -> Result<[f64; 4], String> {
            let (line, number) = lines.next().ok_or_else(|| format!("it ends within the {what}s of a body"))?;
            let values: Vec<f64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
            let good = values.len() == count && values.iter().all(|&value| (value as f32).is_finite());
            let mut all = [0.0; 4];
            if good {
                all[..count].copy_from_slice(&values);
            }
            good.then_some(all).ok_or_else(|| format!("line {number} must be a {what} of {count} numbers"))
        };
        let mut body = Vec::new();
        for _ in 0..frames {
            let [x, y, z, _] = numbers("position", 3)?;
            body.push(BodyFrame { position: DVec3::new(x, y, z), orientation: DQuat::IDENTITY });
        }
        if lines.by_ref().all(|(line, _)| line.trim().is_empty()) {
            return Err("it ends before the orientations of a body".into());
        }
        for frame in &mut body {
            let (line, number) = lines.next().ok_or("it ends within the orientations of a body")?;
            frame.orientation = orientation(line)
                .ok_or_else(|| format!("line {number} must be an orientation: a quaternion, scalar first"))?;
        }
        bodies.push(body);
    }
    if bodies.is_empty() { Err("it has no body".into()) } else { Ok(bodies) }
}

fn orientation(line: &str) -> Option<DQuat> {
    let values: Vec<f64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
    let [s, x, y, z] = values[..] else { return None };
    let quaternion = DQuat::from_xyzw(x, y, z, s);
    (quaternion.is_finite() && quaternion.length() > 1e-6).then(|| quaternion.normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_bodies_of_two_frames() {
        let text = "NumFrames: 2\na position\n0 1 2\n3 4 5\n\na orientation\n1 0 0 0\n0 0 0 2\n\n\nb position\n1 1 1\n1 1 1\nb\n1 0 0 0\n1 0 0 0\n\n";
        let bodies = parse(text).unwrap();
        assert_eq!((bodies.len(), bodies[0].len(), bodies[0][1].position), (2, 2, DVec3::new(3.0, 4.0, 5.0)));
        assert_eq!(bodies[0][0].orientation, DQuat::IDENTITY);
        assert!((bodies[0][1].orientation * DVec3::X).distance(DVec3::NEG_X) < 1e-12, "a half turn about z");
    }

    #[test]
    fn mistakes_name_the_line() {
        let fault = |text: &str| parse(text).unwrap_err();
        assert_eq!(fault(""), "it is empty");
        assert_eq!(fault("NumFrames: 0"), "line 1 must be `NumFrames: n` with n of at least 1");
        assert_eq!(fault("NumFrames: 1\n\n"), "it has no body");
        assert_eq!(fault("NumFrames: 1\na\n0 0\n"), "line 3 must be a position of 3 numbers");
        assert_eq!(fault("NumFrames: 1\na\n0 0 nan\n"), "line 3 must be a position of 3 numbers");
        assert_eq!(fault("NumFrames: 2\na\n0 0 0\n"), "it ends within the positions of a body");
        assert_eq!(fault("NumFrames: 1\na\n0 0 0\n"), "it ends before the orientations of a body");
        assert_eq!(
            fault("NumFrames: 1\na\n0 0 0\nb\n0 0 0 0\n"),
            "line 5 must be an orientation: a quaternion, scalar first"
        );
    }
}
