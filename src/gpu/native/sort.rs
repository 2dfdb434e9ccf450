//! The radix sort in chunks, `sort_count.comp`, `sort_offsets.comp` and `sort_scatter.comp`, and the
//! scan, `scan_sums.comp`, `scan_lanes.comp` and `scan_apply.comp`.
use super::scatter::Scattered;
use crate::gpu::NativeCall;
use rayon::prelude::*;
use std::ops::Range;

const DIGITS: usize = 256;

/// Elements of a lane.
fn chunk(lane: usize, lanes: usize, count: usize) -> Range<usize> {
    let each = count.div_ceil(lanes);
    (lane * each).min(count)..((lane + 1) * each).min(count)
}

fn digit(key: u32, shift: u32, mask: u32) -> usize {
    ((key & mask) >> shift) as usize % DIGITS
}

pub(super) fn count(call: &mut NativeCall) -> Result<(), String> {
    let [shift, mask, lanes, drop] = call.words()?;
    let [pairs, counts, histogram] = call.memory([0, 1, 2])?;
    let (pairs, count): (&[[u32; 2]], usize) = (pairs.of(), counts.of::<u32>()[drop as usize] as usize);
    let histogram = histogram.of::<u32>()[..lanes as usize * DIGITS].par_chunks_mut(DIGITS);
    histogram.enumerate().for_each(|(lane, counts)| {
        counts.fill(0);
        for pair in &pairs[chunk(lane, lanes as usize, count)] {
            let is_kept = drop == 0 || pair[0] & mask != mask;
            counts[digit(pair[0], shift, mask)] += u32::from(is_kept);
        }
    });
    Ok(())
}

pub(super) fn offsets(call: &mut NativeCall) -> Result<(), String> {
    let [lanes, drop] = call.words()?;
    let [histogram, counts] = call.memory([0, 1])?;
    let histogram = histogram.of::<u32>();
    let mut place = 0;
    for digit in 0..DIGITS {
        for lane in 0..lanes as usize {
            let here = &mut histogram[lane * DIGITS + digit];
            (*here, place) = (place, place + *here);
        }
    }
    if drop != 0 {
        counts.of::<u32>()[0] = place;
    }
    Ok(())
}

pub(super) fn scatter(call: &mut NativeCall) -> Result<(), String> {
    let [shift, mask, lanes, drop] = call.words()?;
    let [pairs, counts, histogram, sorted] = call.memory([0, 1, 2, 3])?;
    let (pairs, count): (&[[u32; 2]], usize) = (pairs.of(), counts.of::<u32>()[drop as usize] as usize);
    let (histogram, sorted): (&[u32], _) = (histogram.of(), Scattered::new(sorted.of::<[u32; 2]>()));
    (0..lanes as usize).into_par_iter().for_each(|lane| {
        let mut places = [0; DIGITS];
        places.copy_from_slice(&histogram[lane * DIGITS..(lane + 1) * DIGITS]);
        for pair in &pairs[chunk(lane, lanes as usize, count)] {
            if drop != 0 && pair[0] & mask == mask {
                continue;
            }
            let place = &mut places[digit(pair[0], shift, mask)];
            // SAFETY: the offsets of lanes and digits are disjoint.
            unsafe { sorted.set(*place as usize, *pair) };
            *place += 1;
        }
    });
    Ok(())
}

pub(super) fn scan_sums(call: &mut NativeCall) -> Result<(), String> {
    let [lanes] = call.words()?.map(|word| word as usize);
    let [values, count, sums] = call.memory([0, 1, 2])?;
    let (values, count): (&[u32], usize) = (values.of(), count.of::<u32>()[0] as usize);
    let sums = sums.of::<u32>()[..lanes].par_iter_mut().with_min_len(64).enumerate();
    sums.for_each(|(lane, sum)| {
        *sum = values[chunk(lane, lanes, count)].iter().fold(0, |sum, v| v.saturating_add(sum))
    });
    Ok(())
}

pub(super) fn scan_lanes(call: &mut NativeCall) -> Result<(), String> {
    let [lanes] = call.words()?.map(|word| word as usize);
    let [sums, total] = call.memory([0, 1])?;
    let mut start = 0u32;
    for sum in &mut sums.of::<u32>()[..lanes] {
        (*sum, start) = (start, start.saturating_add(*sum));
    }
    total.of::<u32>()[0] = start;
    Ok(())
}

pub(super) fn scan_apply(call: &mut NativeCall) -> Result<(), String> {
    let [lanes] = call.words()?.map(|word| word as usize);
    let [values, count, sums, starts] = call.memory([0, 1, 2, 3])?;
    let (values, sums): (&[u32], &[u32]) = (values.of(), sums.of());
    let count = count.of::<u32>()[0] as usize;
    let each = count.div_ceil(lanes).max(1);
    let starts = starts.of::<u32>()[..count].par_chunks_mut(each).with_min_len(64).enumerate();
    starts.for_each(|(lane, starts)| {
        let mut start = sums[lane];
        for (place, value) in starts.iter_mut().zip(&values[lane * each..]) {
            (*place, start) = (start, start.saturating_add(*value));
        }
    });
    Ok(())
}
