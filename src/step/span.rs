//! The time that one implicit step covers: a step of the scene or a part of it.

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

    /// The two halves, in order.
    pub(super) fn halves(self) -> [Span; 2] {
        let length_s = 0.5 * self.length_s;
        let middle_s = self.start_s + length_s;
        [Span { end_s: middle_s, length_s, ..self }, Span { start_s: middle_s, length_s, ..self }]
    }
}
