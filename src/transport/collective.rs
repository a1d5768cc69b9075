//! Exchanges of all ranks with all ranks: lists of any length, cut into messages of the size that the transport
//! reserved, and the positions of the whole cloth. Every rank calls them at the same point of the collective program.

use std::ops::Range;

use bytemuck::Pod;

use super::{ALL_GATHER_MAX, Transport, TransportError};

/// Passes the list of every rank to `read(rank, part)`: first the own list, then those of the others in parts, each
/// rank's parts in order. Items are whole 32-bit words with at most their alignment. Returns the number of items of
/// every rank.
///
/// Messages: one all-gather of the lengths, then as many rounds as the longest list needs (none if all are empty). A
/// rank sends only in the rounds in which it has items left.
pub fn share_lists<T: Pod>(
    transport: &mut dyn Transport,
    own: &[T],
    read: &mut dyn FnMut(usize, &[T]),
) -> Result<Vec<usize>, TransportError> {
    let mut lengths = vec![own.len()];
    if transport.ranks() > 1 {
        let mut gathered = Vec::new();
        transport.all_gather(&[own.len() as f64], &mut gathered)?;
        lengths = gathered.iter().map(|l| l.first().map_or(0, |&l| l as usize)).collect();
    }
    share_known(transport, own, &lengths, read)?;
    Ok(lengths)
}

/// Completes a list of which every rank has computed the range `of(rank)`. As [`share_lists`], without the all-gather.
pub fn share_ranges<T: Pod>(
    transport: &mut dyn Transport,
    all: &mut [T],
    of: impl Fn(usize) -> Range<usize>,
) -> Result<(), TransportError> {
    let ranges: Vec<Range<usize>> = (0..transport.ranks()).map(of).collect();
    let lengths: Vec<usize> = ranges.iter().map(Range::len).collect();
    let own = all[ranges[transport.rank()].clone()].to_vec();
    let mut next: Vec<usize> = ranges.iter().map(|range| range.start).collect();
    share_known(transport, &own, &lengths, &mut |source, part: &[T]| {
        all[next[source]..next[source] + part.len()].copy_from_slice(part);
        next[source] += part.len();
    })
}

/// Completes the positions of the whole cloth, `all`. Rank r owns the values `of(r)`; `own` has those of this rank.
///
/// Bytes: every rank receives the whole cloth once, 12 per vertex. Rows are not selected, because contacts can join any
/// two places. A transport between machines should send them to each machine once (an all-gather of lists of known
/// lengths).
pub fn share_positions(
    transport: &mut dyn Transport,
    own: &[f32],
    all: &mut [f32],
    of: impl Fn(usize) -> Range<usize>,
) -> Result<(), TransportError> {
    all[of(transport.rank())].copy_from_slice(own);
    share_ranges(transport, all, of)
}

/// As [`share_lists`], if all ranks know the number of items of every rank.
fn share_known<T: Pod>(
    transport: &mut dyn Transport,
    own: &[T],
    lengths: &[usize],
    read: &mut dyn FnMut(usize, &[T]),
) -> Result<(), TransportError> {
    const { assert!(size_of::<T>().is_multiple_of(4) && align_of::<T>() <= 4, "items must be whole 32-bit words") };
    let (rank, ranks, words) = (transport.rank(), transport.ranks(), size_of::<T>() / 4);
    read(rank, own);
    if ranks == 1 {
        return Ok(());
    }
    let most = transport.max_message_values() / words;
    let longest = lengths.iter().copied().max().unwrap_or(0);
    if longest > 0 && most == 0 {
        let message = format!("messages of {} values hold no item of {words}", transport.max_message_values());
        return Err(TransportError::Mechanism { rank, message });
    }
    let piece = |len: usize, round: usize| (round * most).min(len)..((round + 1) * most).min(len);
    let rounds = if longest == 0 { 0 } else { longest.div_ceil(most) };
    for round in 0..rounds {
        let part: &[f32] = bytemuck::cast_slice(&own[piece(own.len(), round)]);
        let values: Vec<usize> = lengths.iter().map(|&len| piece(len, round).len() * words).collect();
        transport.share(&values, part, &mut |source, values| {
            if source != rank {
                read(source, bytemuck::cast_slice(values));
            }
        })?;
    }
    Ok(())
}

/// The lists of all ranks, concatenated in rank order, of any length: an all-gather of the lengths, then as many
/// all-gathers as the longest list needs.
pub fn gather_lists(transport: &mut dyn Transport, own: &[f64]) -> Result<Vec<f64>, TransportError> {
    if transport.ranks() == 1 {
        return Ok(own.to_vec());
    }
    let mut parts = Vec::new();
    transport.all_gather(&[own.len() as f64], &mut parts)?;
    let lengths: Vec<usize> = parts.iter().map(|part| part.first().map_or(0, |&n| n as usize)).collect();
    let mut all: Vec<Vec<f64>> = vec![Vec::new(); lengths.len()];
    let rounds = lengths.iter().max().map_or(0, |n| n.div_ceil(ALL_GATHER_MAX));
    for round in 0..rounds {
        let range = (round * ALL_GATHER_MAX).min(own.len())..((round + 1) * ALL_GATHER_MAX).min(own.len());
        transport.all_gather(&own[range], &mut parts)?;
        for (all, part) in all.iter_mut().zip(&parts) {
            all.extend_from_slice(part);
        }
    }
    Ok(all.concat())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::InProcessTransport;

    #[test]
    fn every_rank_gets_every_list_whole_and_in_order() {
        for lens in [vec![0, 0, 0], vec![5, 0, 17], vec![1, 2, 3], vec![40, 40, 40]] {
            let threads: Vec<_> = InProcessTransport::group(3)
                .into_iter()
                .map(|mut transport| {
                    transport.set_max_message_values(8);
                    let lens = lens.clone();
                    std::thread::spawn(move || {
                        let rank = transport.rank();
                        let list = |r: usize| (0..lens[r]).map(|i| [r as u32, i as u32]).collect::<Vec<_>>();
                        let mut found = vec![Vec::new(); 3];
                        let lengths = share_lists(&mut transport, &list(rank), &mut |source, part: &[[u32; 2]]| {
                            found[source].extend_from_slice(part);
                        });
                        assert_eq!(lengths.unwrap(), lens);
                        assert_eq!(found, [list(0), list(1), list(2)]);
                    })
                })
                .collect();
            threads.into_iter().for_each(|thread| thread.join().unwrap());
        }
    }

    #[test]
    fn lists_of_numbers_come_in_rank_order() {
        let lens = [ALL_GATHER_MAX + 5, 0, 3];
        let threads: Vec<_> = InProcessTransport::group(3)
            .into_iter()
            .map(|mut transport| {
                std::thread::spawn(move || {
                    let list = |rank: usize| (0..lens[rank]).map(move |i| (rank * 10_000 + i) as f64);
                    let own: Vec<f64> = list(transport.rank()).collect();
                    let all = gather_lists(&mut transport, &own).unwrap();
                    assert!(all.into_iter().eq((0..3).flat_map(list)));
                    assert_eq!(transport.counts().published, 0, "all-gathers need no messages");
                })
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
    }

    #[test]
    fn what_was_not_announced_is_refused() {
        let mut alone = InProcessTransport::group(1).remove(0);
        let error = alone.share(&[2], &[1.0], &mut |_, _| ()).unwrap_err().to_string();
        assert!(error.contains("1 values of rank 0 to share where [2] were announced"), "{error}");
    }

    #[test]
    fn every_rank_completes_the_ranges_of_all() {
        let ranges = [0..3, 3..3, 3..20];
        let threads: Vec<_> = InProcessTransport::group(3)
            .into_iter()
            .map(|mut transport| {
                transport.set_max_message_values(4);
                let ranges = ranges.clone();
                std::thread::spawn(move || {
                    let mut all = [[0u32; 2]; 20];
                    for at in ranges[transport.rank()].clone() {
                        all[at] = [at as u32, 7];
                    }
                    share_ranges(&mut transport, &mut all, |rank| ranges[rank].clone()).unwrap();
                    assert_eq!(all, std::array::from_fn(|at| [at as u32, 7]));
                })
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
    }
}
