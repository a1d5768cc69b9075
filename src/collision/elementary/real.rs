//! Arithmetic shared by the f32 and the f64 form of the tests. Nothing here allocates or branches on the type, so that
//! the f32 form can be written down in WGSL line by line.

use std::ops::{Add, Div, Mul, Sub};

use crate::math::Vec3;

/// A 3-vector of either precision.
pub(super) type V<T> = [T; 3];

/// f32 (device, filter) or f64 (fallback).
pub(super) trait Real:
    Copy + PartialOrd + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self>
{
    const ZERO: Self;
    const ONE: Self;
    /// Half the distance from 1 to the next larger number.
    const ROUNDOFF: Self;
    /// Exceeds the absolute error of a few dozen operations that underflow, also where subnormal numbers are flushed.
    const UNDERFLOW: Self;
    fn of(x: f32) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// The smaller one; unordered operands give either.
    fn least(self, other: Self) -> Self {
        if other < self { other } else { self }
    }
    /// The larger one; unordered operands give either.
    fn most(self, other: Self) -> Self {
        if other > self { other } else { self }
    }
}

impl Real for f32 {
    const ZERO: f32 = 0.0;
    const ONE: f32 = 1.0;
    const ROUNDOFF: f32 = f32::EPSILON / 2.0;
    // 2^-120
    const UNDERFLOW: f32 = 7.523_164e-37;
    fn of(x: f32) -> f32 {
        x
    }
    fn abs(self) -> f32 {
        self.abs()
    }
    fn sqrt(self) -> f32 {
        self.sqrt()
    }
}

impl Real for f64 {
    const ZERO: f64 = 0.0;
    const ONE: f64 = 1.0;
    const ROUNDOFF: f64 = f64::EPSILON / 2.0;
    // 2^-1016
    const UNDERFLOW: f64 = 64.0 * f64::MIN_POSITIVE;
    fn of(x: f32) -> f64 {
        f64::from(x)
    }
    fn abs(self) -> f64 {
        self.abs()
    }
    fn sqrt(self) -> f64 {
        self.sqrt()
    }
}

pub(super) fn of<T: Real>(v: Vec3) -> V<T> {
    [T::of(v.x), T::of(v.y), T::of(v.z)]
}

pub(super) fn add<T: Real>(a: V<T>, b: V<T>) -> V<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(super) fn sub<T: Real>(a: V<T>, b: V<T>) -> V<T> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(super) fn scale<T: Real>(s: T, a: V<T>) -> V<T> {
    [s * a[0], s * a[1], s * a[2]]
}

pub(super) fn dot<T: Real>(a: V<T>, b: V<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross<T: Real>(a: V<T>, b: V<T>) -> V<T> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Largest absolute component.
pub(super) fn size<T: Real>(a: V<T>) -> T {
    a[0].abs().most(a[1].abs()).most(a[2].abs())
}

pub(super) fn clamp01<T: Real>(x: T) -> T {
    x.most(T::ZERO).least(T::ONE)
}
