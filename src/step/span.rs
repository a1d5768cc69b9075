//! The time that one implicit step covers: a step of the scene or a part of it.

use std::ops::Range;

/// Time of a step or of a part of one, seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Span {
    pub start_s: f64,
    /// Exactly the start of the next span, so that pins and obstacles end one span where they begin the next.
    pub end_s: f64,
    pub length_s: f64,
}

impl Span {
    /// Step `step`, counted from 1, of `step_s` seconds.
    pub(super) fn of_step(step: u32, step_s: f64) -> Span {
        Span { start_s: (step - 1) as f64 * step_s, end_s: step as f64 * step_s, length_s: step_s }
    }

    /// The part from `range.start` to `range.end` of `of` equal ones.
    pub(super) fn part(self, range: Range<u32>, of: u32) -> Span {
        let at = |number: u32| match number {
            _ if number == of => self.end_s,
            _ => self.start_s + self.length_s * (f64::from(number) / f64::from(of)),
        };
        let length_s = self.length_s * (f64::from(range.end - range.start) / f64::from(of));
        Span { start_s: at(range.start), end_s: at(range.end), length_s }
    }

    /// The two halves, in order.
    pub(super) fn halves(self) -> [Span; 2] {
        let length_s = 0.5 * self.length_s;
        let middle_s = self.start_s + length_s;
        [Span { end_s: middle_s, length_s, ..self }, Span { start_s: middle_s, length_s, ..self }]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_follow_each_other_from_the_start_to_the_end() {
        let step = Span::of_step(7, 1.0 / 24.0);
        for of in [1, 3, 8] {
            let parts: Vec<Span> = (0..of).map(|i| step.part(i..i + 1, of)).collect();
            assert_eq!((parts[0].start_s, parts[parts.len() - 1].end_s), (step.start_s, step.end_s));
            assert!(parts.windows(2).all(|pair| pair[0].end_s == pair[1].start_s));
            assert!(parts.iter().all(|part| part.length_s == step.length_s * (1.0 / f64::from(of))));
        }
        assert_eq!(step.part(0..5, 5), step);
    }
}
