//! Lists of any length from every rank to every rank, cut into messages that fit what the transport reserved.
//! Part of the collective program: every rank calls it at the same place.

use std::ops::Range;

use bytemuck::Pod;

use super::{Transport, TransportError};

/// Hands the list of every rank to `read(rank, part)`: the own one first, then the others' in pieces, each rank's pieces in
/// order. Items are whole 32-bit words, at most as aligned. Returns the number of items of every rank.
///
/// Messages: one all-gather of the lengths, then as many rounds as the longest list needs (none if all are empty).
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

/// Completes a list of which every rank has made the range `of(rank)`: as [`share_lists`], without the all-gather.
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

/// As [`share_lists`], if everybody knows how many items every rank has.
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
        transport.publish(part.len(), &mut |out| out.copy_from_slice(part))?;
        for step in 1..ranks {
            let source = (rank + step) % ranks;
            let expected = piece(lengths[source], round).len();
            let mut got = 0;
            transport.receive(source, &mut |values| {
                got = values.len();
                if got == expected * words {
                    read(source, bytemuck::cast_slice(values));
                }
            })?;
            if got != expected * words {
                let message = format!("a list of rank {source} holds {got} values instead of {}", expected * words);
                return Err(TransportError::Mechanism { rank, message });
            }
        }
    }
    Ok(())
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
