//! Lists of any length from every rank to every rank, cut into messages that fit what the transport reserved.
//! Part of the collective program: every rank calls it at the same place.

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
    const { assert!(size_of::<T>().is_multiple_of(4) && align_of::<T>() <= 4, "items must be whole 32-bit words") };
    let (rank, ranks, words) = (transport.rank(), transport.ranks(), size_of::<T>() / 4);
    read(rank, own);
    if ranks == 1 {
        return Ok(vec![own.len()]);
    }
    let mut lengths = Vec::new();
    transport.all_gather(&[own.len() as f64], &mut lengths)?;
    let lengths: Vec<usize> = lengths.iter().map(|l| l.first().map_or(0, |&l| l as usize)).collect();
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
    Ok(lengths)
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
}
