use std::time::Duration;

/// Sub-buckets per octave, as a power of two: a bucket is at most 1/16 of its value wide.
const SUB_BITS: u32 = 4;
const SUB: usize = 1 << SUB_BITS;
/// Values of 2^40 ns (18 minutes) and more share the last bucket.
const TOP_BITS: u32 = 40;
const BUCKETS: usize = ((TOP_BITS - SUB_BITS) as usize + 1) * SUB;

/// A latency histogram of fixed size: logarithmic buckets of 6.25 % over 0 ns to 18 minutes.
///
/// Recording is a handful of instructions without allocation, so a control thread may own one; a copy is 2.3 KiB.
#[derive(Clone, Copy, Debug)]
pub struct Histogram {
    counts: [u32; BUCKETS],
    count: u64,
    max_ns: u64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: [0; BUCKETS], count: 0, max_ns: 0 }
    }
}

impl Histogram {
    /// Counts one value.
    pub fn record(&mut self, value: Duration) {
        self.record_ns(u64::try_from(value.as_nanos()).unwrap_or(u64::MAX));
    }

    /// Counts one value, ns.
    pub fn record_ns(&mut self, ns: u64) {
        let slot = &mut self.counts[bucket(ns)];
        *slot = slot.saturating_add(1);
        self.count = self.count.saturating_add(1);
        self.max_ns = self.max_ns.max(ns);
    }

    /// Values counted so far.
    #[must_use]
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// The largest value, exactly; zero if nothing was recorded.
    #[must_use]
    pub const fn max(&self) -> Duration {
        Duration::from_nanos(self.max_ns)
    }

    /// The value that the fraction `p` (0 to 1) of the records does not exceed; zero if nothing was recorded.
    ///
    /// It is the upper edge of a bucket: never below the true quantile, and above it by at most 6.25 % (and 1 ns).
    #[must_use]
    pub fn quantile(&self, p: f64) -> Duration {
        let rank = ((p.clamp(0.0, 1.0) * self.count as f64).ceil() as u64).max(1);
        let mut seen = 0;
        for (index, &count) in self.counts.iter().enumerate() {
            seen += u64::from(count);
            if seen >= rank {
                return Duration::from_nanos(upper_edge(index).min(self.max_ns));
            }
        }
        self.max()
    }

    /// The median.
    #[must_use]
    pub fn p50(&self) -> Duration {
        self.quantile(0.50)
    }

    /// The 99th percentile.
    #[must_use]
    pub fn p99(&self) -> Duration {
        self.quantile(0.99)
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }
}

fn bucket(ns: u64) -> usize {
    if ns < SUB as u64 {
        return ns as usize;
    }
    let octave = ns.ilog2() - SUB_BITS;
    let index = (octave as usize + 1) * SUB + (((ns >> octave) as usize) & (SUB - 1));
    index.min(BUCKETS - 1)
}

/// The largest value of a bucket, ns.
fn upper_edge(index: usize) -> u64 {
    if index < SUB {
        return index as u64;
    }
    if index == BUCKETS - 1 {
        return u64::MAX;
    }
    let octave = index / SUB - 1;
    ((((index % SUB) + SUB + 1) as u64) << octave) - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_and_buckets_agree() {
        for index in 0..BUCKETS - 1 {
            let edge = upper_edge(index);
            assert_eq!(bucket(edge), index, "upper edge {edge} of bucket {index}");
            assert_eq!(bucket(edge + 1), index + 1, "above bucket {index}");
        }
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
    }
}
