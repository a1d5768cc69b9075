//! Exact referee of continuous collision for vertices on an integer grid. Shares nothing with the tests of the library:
//! contact times are algebraic numbers, isolated by Sturm sequences; every sign at them is decided in integers.
//!
//! The parts of a stencil touch at t iff polynomials in t have certain signs there (coplanarity, barycentric weights,
//! and for collapsed shapes the position along a line). The first contact is at t = 0 or where one of these polynomials
//! vanishes: it is enough to look there.

use loomtree::collision::elementary::CandidateKind;
use num_bigint::{BigInt, Sign};

/// Positions of a stencil on the grid.
pub type Grid = [[i64; 3]; 4];

/// The first contact lies in `[low, high]`, outward rounded, with a width of about 2^-40.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstContact {
    pub low: f64,
    pub high: f64,
}

/// First contact in [0, 1] of linear trajectories, or none.
pub fn first_contact(kind: CandidateKind, x_t0: Grid, x_t1: Grid) -> Option<FirstContact> {
    if apart_along_an_axis(kind, &x_t0, &x_t1) || never_coplanar(&x_t0, &x_t1) {
        return None;
    }
    let stencil = Moving { kind, x: std::array::from_fn(|i| std::array::from_fn(|c| linear(x_t0[i][c], x_t1[i][c]))) };
    let coplanar = stencil.coplanar();
    if !is_zero(&coplanar) && one_sign(&bernstein_on(&coplanar, &BigInt::ZERO, 0)).is_some() {
        return None;
    }
    let start = At::Point(BigInt::ZERO, 0);
    if stencil.touches(&start) {
        return Some(FirstContact { low: 0.0, high: 0.0 });
    }
    let conditions = if is_zero(&coplanar) { stencil.conditions() } else { vec![coplanar] };
    let mut contacts: Vec<FirstContact> = Vec::new();
    for condition in conditions.iter().filter(|c| c.len() > 1) {
        let free = square_free(condition);
        for root in roots_in_unit(&free) {
            if stencil.touches(&root) {
                contacts.push(root.bounds());
            }
        }
    }
    contacts.into_iter().min_by(|a, b| a.low.total_cmp(&b.low))
}

// --- quick proofs, exact in i128 for grids up to 2^24 ---------------------------------------------------------------

/// Do the parts lie on two sides of a plane across a coordinate axis or a diagonal, at both ends and so all the way?
fn apart_along_an_axis(kind: CandidateKind, x_t0: &Grid, x_t1: &Grid) -> bool {
    let first = if kind == CandidateKind::VertexFace { 1 } else { 2 };
    let directions = (0..27).map(|i| [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1]).filter(|d: &[i64; 3]| *d != [0; 3]);
    let along = |d: [i64; 3], p: &[i64; 3]| d[0] * p[0] + d[1] * p[1] + d[2] * p[2];
    directions.into_iter().any(|d| {
        [x_t0, x_t1].into_iter().all(|x| {
            let low = x[..first].iter().map(|p| along(d, p)).max();
            low < x[first..].iter().map(|p| along(d, p)).min()
        })
    })
}

/// Have the Bernstein coefficients of the volume over time one sign? Then the four points are never in one plane.
fn never_coplanar(x_t0: &Grid, x_t1: &Grid) -> bool {
    let edges = |x: &Grid| -> [[i128; 3]; 3] {
        std::array::from_fn(|i| std::array::from_fn(|c| i128::from(x[i + 1][c] - x[0][c])))
    };
    let (a, b) = (edges(x_t0), edges(x_t1));
    let volume = |[u, v, w]: [[i128; 3]; 3]| {
        u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) + u[2] * (v[0] * w[1] - v[1] * w[0])
    };
    let with = |from: [[i128; 3]; 3], other: [[i128; 3]; 3], i: usize| {
        let mut edges = from;
        edges[i] = other[i];
        volume(edges)
    };
    let mixed = |from, other| (0..3).map(|i| with(from, other, i)).sum::<i128>();
    let coefficients = [volume(a), mixed(a, b), mixed(b, a), volume(b)];
    coefficients.iter().all(|&c| c > 0) || coefficients.iter().all(|&c| c < 0)
}

// --- polynomials with integer coefficients, lowest first, highest not zero ------------------------------------------

type Poly = Vec<BigInt>;
type Vector = [Poly; 3];

fn trimmed(mut p: Poly) -> Poly {
    while p.last().is_some_and(|c| c.sign() == Sign::NoSign) {
        p.pop();
    }
    p
}

fn is_zero(p: &Poly) -> bool {
    p.is_empty()
}

fn linear(a: i64, b: i64) -> Poly {
    trimmed(vec![a.into(), (b - a).into()])
}

fn plus(a: &Poly, b: &Poly, sign: i32) -> Poly {
    let at = |p: &Poly, i: usize| p.get(i).cloned().unwrap_or_default();
    trimmed((0..a.len().max(b.len())).map(|i| at(a, i) + sign * at(b, i)).collect())
}

fn times(a: &Poly, b: &Poly) -> Poly {
    let mut out = vec![BigInt::ZERO; (a.len() + b.len()).saturating_sub(1)];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    trimmed(out)
}

fn minus(a: &Vector, b: &Vector) -> Vector {
    std::array::from_fn(|c| plus(&a[c], &b[c], -1))
}

fn cross(a: &Vector, b: &Vector) -> Vector {
    std::array::from_fn(|c| {
        let (i, j) = ((c + 1) % 3, (c + 2) % 3);
        plus(&times(&a[i], &b[j]), &times(&a[j], &b[i]), -1)
    })
}

fn dot(a: &Vector, b: &Vector) -> Poly {
    (0..3).fold(Poly::new(), |sum, c| plus(&sum, &times(&a[c], &b[c]), 1))
}

/// A positive multiple of the remainder of a / b.
fn remainder(a: &Poly, b: &Poly) -> Poly {
    let mut rest = a.clone();
    let lead = b.last().expect("a divisor that is not zero");
    while rest.len() >= b.len() {
        let factor = if lead.sign() == Sign::Minus { -rest.last().unwrap() } else { rest.last().unwrap().clone() };
        let shift = rest.len() - b.len();
        for c in &mut rest {
            *c *= BigInt::from(lead.magnitude().clone());
        }
        for (i, c) in b.iter().enumerate() {
            rest[i + shift] -= &factor * c;
        }
        rest = trimmed(rest);
    }
    rest
}

fn gcd(a: &Poly, b: &Poly) -> Poly {
    let (mut a, mut b) = (a.clone(), b.clone());
    while !b.is_empty() {
        (a, b) = (b.clone(), remainder(&a, &b));
    }
    a
}

fn derivative(p: &Poly) -> Poly {
    trimmed(p.iter().enumerate().skip(1).map(|(i, c)| c * i).collect())
}

/// A multiple of a / b, for a b that divides a over the rationals.
fn quotient(a: &Poly, b: &Poly) -> Poly {
    let (mut rest, lead) = (a.clone(), b.last().unwrap());
    let mut out = vec![BigInt::ZERO; a.len() - b.len() + 1];
    while rest.len() >= b.len() {
        let (factor, shift) = (rest.last().unwrap().clone(), rest.len() - b.len());
        for c in rest.iter_mut().chain(&mut out) {
            *c *= lead;
        }
        out[shift] += &factor;
        for (i, c) in b.iter().enumerate() {
            rest[i + shift] -= &factor * c;
        }
        rest = trimmed(rest);
    }
    trimmed(out)
}

/// Same roots, each once.
fn square_free(p: &Poly) -> Poly {
    let common = gcd(p, &derivative(p));
    if common.len() > 1 { quotient(p, &common) } else { p.clone() }
}

/// Sign at m / 2^k.
fn sign_at(p: &Poly, m: &BigInt, k: u64) -> i32 {
    let mut value = BigInt::ZERO;
    for (power, c) in p.iter().rev().enumerate() {
        value = value * m + (c << (k * power as u64));
    }
    sign(&value)
}

fn sign(x: &BigInt) -> i32 {
    match x.sign() {
        Sign::Minus => -1,
        Sign::NoSign => 0,
        Sign::Plus => 1,
    }
}

/// Positive multiples of the Bernstein coefficients on [m / 2^k, (m + 1) / 2^k].
fn bernstein_on(p: &Poly, m: &BigInt, k: u64) -> Vec<BigInt> {
    let n = p.len() - 1;
    let mut q: Poly = p.iter().enumerate().map(|(i, c)| c << (k * (n - i) as u64)).collect();
    if m.sign() != Sign::NoSign {
        for end in 0..n {
            for i in (end..n).rev() {
                let next = &q[i + 1] * m;
                q[i] += next;
            }
        }
    }
    // b_j = sum_i C(j, i) / C(n, i) q_i, times n! to stay in integers.
    let binomial = |n: usize, i: usize| (0..i).fold(1u64, |b, l| b * (n - l) as u64 / (l + 1) as u64);
    let scale: u64 = (1..=n as u64).product();
    (0..=n).map(|j| (0..=j).map(|i| &q[i] * (binomial(j, i) * (scale / binomial(n, i)))).sum()).collect()
}

/// The sign that all coefficients share, if it is not zero.
fn one_sign(coefficients: &[BigInt]) -> Option<i32> {
    let first = sign(&coefficients[0]);
    (first != 0 && coefficients.iter().all(|c| sign(c) == first)).then_some(first)
}

// --- real algebraic numbers in [0, 1] -------------------------------------------------------------------------------

/// A time: m / 2^k, or the only root of a square-free polynomial in (m / 2^k, (m + 1) / 2^k), no root at its ends.
enum At<'a> {
    Point(BigInt, u64),
    Root(&'a Poly, BigInt, u64),
}

/// Roots of a square-free polynomial in [0, 1], isolated to a width of 2^-40.
fn roots_in_unit(p: &Poly) -> Vec<At<'_>> {
    let mut found = Vec::new();
    if sign(&p[0]) == 0 {
        found.push(At::Point(BigInt::ZERO, 0));
    }
    let mut sturm = vec![p.clone(), derivative(p)];
    while sturm.last().is_some_and(|last| last.len() > 1) {
        let rest = remainder(&sturm[sturm.len() - 2], &sturm[sturm.len() - 1]);
        sturm.push(rest.iter().map(|c| -c).collect());
    }
    let variations = |m: &BigInt, k: u64| {
        let signs: Vec<i32> = sturm.iter().map(|q| sign_at(q, m, k)).filter(|&s| s != 0).collect();
        signs.windows(2).filter(|pair| pair[0] != pair[1]).count()
    };
    let mut open = vec![(BigInt::ZERO, 0u64)];
    while let Some((m, k)) = open.pop() {
        let next: BigInt = &m + 1;
        // Roots in (m / 2^k, (m + 1) / 2^k].
        let count = variations(&m, k) - variations(&next, k);
        if count == 0 {
            continue;
        }
        let ends = (sign_at(p, &m, k), sign_at(p, &next, k));
        if count == 1 && ends.1 == 0 {
            found.push(At::Point(next, k));
        } else if count == 1 && ends.0 != 0 && k >= 40 {
            found.push(At::Root(p, m, k));
        } else if count == 1 && ends.0 != 0 {
            // One sign change: a bisection by signs is cheaper than by Sturm sequences.
            let (mut m, mut k) = (m, k);
            let mut at_middle = false;
            while k < 40 && !at_middle {
                (m, k) = (m * 2, k + 1);
                let middle: BigInt = &m + 1;
                let side = sign_at(p, &middle, k);
                at_middle = side == 0;
                if side == ends.0 || at_middle {
                    m = middle;
                }
            }
            found.push(if at_middle { At::Point(m, k) } else { At::Root(p, m, k) });
        } else {
            open.extend([(&m * 2, k + 1), (&m * 2 + 1, k + 1)]);
        }
    }
    found
}

impl At<'_> {
    fn sign_of(&self, g: &Poly) -> i32 {
        if g.is_empty() {
            return 0;
        }
        match self {
            At::Point(m, k) => sign_at(g, m, *k),
            At::Root(p, m, k) => {
                let (mut m, mut k) = (m.clone(), *k);
                let below = sign_at(p, &m, k);
                let mut shared_checked = false;
                loop {
                    if let Some(sign) = one_sign(&bernstein_on(g, &m, k)) {
                        return sign;
                    }
                    if !shared_checked {
                        // Every root of the common divisor is one of p, so at most one is here, and it is simple.
                        let common = gcd(p, g);
                        if sign_at(&common, &m, k) * sign_at(&common, &(&m + 1), k) < 0 {
                            return 0;
                        }
                        shared_checked = true;
                    }
                    (m, k) = (m * 2, k + 1);
                    let middle: BigInt = &m + 1;
                    let side = sign_at(p, &middle, k);
                    if side == 0 {
                        return sign_at(g, &middle, k);
                    }
                    if side == below {
                        m = middle;
                    }
                }
            }
        }
    }

    fn bounds(&self) -> FirstContact {
        let value = |m: &BigInt, k: u64| {
            let m: f64 = m.to_string().parse().expect("a number");
            m / 2f64.powi(k as i32)
        };
        match self {
            At::Point(m, k) => FirstContact { low: value(m, *k).next_down(), high: value(m, *k).next_up() },
            At::Root(_, m, k) => FirstContact { low: value(m, *k).next_down(), high: value(&(m + 1), *k).next_up() },
        }
    }
}

// --- the stencil ----------------------------------------------------------------------------------------------------

struct Moving {
    kind: CandidateKind,
    x: [Vector; 4],
}

impl Moving {
    fn coplanar(&self) -> Poly {
        let [p, a, b, c] = &self.x;
        dot(&cross(&minus(b, a), &minus(c, a)), &minus(p, a))
    }

    fn segments_of_face(&self) -> [[usize; 2]; 3] {
        [[1, 2], [2, 3], [3, 1]]
    }

    /// (point, segment) pairs that decide where the parts have no common plane normal.
    fn point_segments(&self) -> Vec<(usize, [usize; 2])> {
        match self.kind {
            CandidateKind::VertexFace => self.segments_of_face().map(|s| (0, s)).to_vec(),
            CandidateKind::EdgeEdge => vec![(0, [2, 3]), (1, [2, 3]), (2, [0, 1]), (3, [0, 1])],
        }
    }

    /// The normal, and polynomials that are not negative where the parts touch, given that all is in one plane and the
    /// normal is not zero.
    fn inside(&self) -> (Vector, Vec<Poly>) {
        let x = &self.x;
        match self.kind {
            CandidateKind::VertexFace => {
                let normal = cross(&minus(&x[2], &x[1]), &minus(&x[3], &x[1]));
                let areas = self
                    .segments_of_face()
                    .map(|[i, j]| dot(&cross(&minus(&x[j], &x[i]), &minus(&x[0], &x[i])), &normal));
                (normal, areas.to_vec())
            }
            CandidateKind::EdgeEdge => {
                let (u, v, r) = (minus(&x[1], &x[0]), minus(&x[3], &x[2]), minus(&x[2], &x[0]));
                let normal = cross(&u, &v);
                // r = s u - t v in the plane: r x v = s n, r x u = t n.
                let (s, t) = (dot(&cross(&r, &v), &normal), dot(&cross(&r, &u), &normal));
                let all = dot(&normal, &normal);
                let rest = [plus(&all, &s, -1), plus(&all, &t, -1)];
                (normal, [s, t].into_iter().chain(rest).collect())
            }
        }
    }

    fn on_segment(&self, (p, [a, b]): (usize, [usize; 2])) -> [Vector; 4] {
        let (ab, ap, bp) =
            (minus(&self.x[b], &self.x[a]), minus(&self.x[p], &self.x[a]), minus(&self.x[p], &self.x[b]));
        let along = [dot(&ap, &ab), plus(&Poly::new(), &dot(&bp, &ab), -1), Poly::new()];
        [cross(&ab, &ap), ab, ap, along]
    }

    fn touches(&self, at: &At) -> bool {
        let vanishes = |v: &Vector| v.iter().all(|c| at.sign_of(c) == 0);
        if at.sign_of(&self.coplanar()) != 0 {
            return false;
        }
        let (normal, not_negative) = self.inside();
        if !vanishes(&normal) {
            return not_negative.iter().all(|p| at.sign_of(p) >= 0);
        }
        self.point_segments().into_iter().any(|pair| {
            let [off_line, ab, ap, along] = self.on_segment(pair);
            if vanishes(&ab) {
                return vanishes(&ap);
            }
            vanishes(&off_line) && along.iter().all(|p| at.sign_of(p) >= 0)
        })
    }

    /// Every polynomial whose sign `touches` may ask for.
    fn conditions(&self) -> Vec<Poly> {
        let (normal, mut all) = self.inside();
        all.extend(normal);
        for pair in self.point_segments() {
            all.extend(self.on_segment(pair).into_iter().flatten());
        }
        all
    }
}
