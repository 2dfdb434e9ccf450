//! Data that queries share, kept within a bound: users may ask any text.
use crate::query::TextQuery;
use crate::query::presence::Background;
use std::sync::Arc;

/// Bound of the kept embeddings, bytes: those of texts without a colour and of all with one take 20
/// MB from `words`; some space remains.
const MOST_BYTES: usize = 32 << 20;

/// Most queries that are kept. One takes 30 kB, or 90 kB with the colours that it is not.
const MOST_QUERIES: usize = 64;

/// Cache by text; evicts the least recently asked text.
#[derive(Default)]
pub(super) struct RecentQueries {
    /// Whether all words count, and the query; ordered by use, the latest last.
    list: Vec<(bool, Arc<TextQuery>)>,
}

impl RecentQueries {
    /// Returns the query of a text, of which all words count with `verbatim`; makes it if it is
    /// absent.
    pub(super) fn entry<E>(
        &mut self,
        (text, verbatim): (&str, bool),
        make: impl FnOnce(&str) -> Result<TextQuery, E>,
    ) -> Result<Arc<TextQuery>, E> {
        let query = match self.list.iter().position(|known| known.0 == verbatim && known.1.text == text) {
            Some(index) => self.list.remove(index).1,
            None => Arc::new(make(text)?),
        };
        let surplus = (self.list.len() + 1).saturating_sub(MOST_QUERIES);
        self.list.drain(..surplus);
        self.list.push((verbatim, query.clone()));
        Ok(query)
    }
}

/// Data that texts of one form share.
pub(super) struct CachedAlternatives {
    /// Embeddings of the alternatives, [N, D].
    pub things: Arc<Vec<f32>>,
    /// Fit of the alternatives to the scene, once computed.
    pub background: Option<Background>,
}

/// Cache by the form of a text (`things::form`); evicts the least recently used form.
#[derive(Default)]
pub(super) struct AlternativesCache {
    /// Ordered by use, the latest last.
    list: Vec<(String, CachedAlternatives)>,
}

impl AlternativesCache {
    /// Returns the entry of a form; computes it if it is absent.
    pub(super) fn entry<E>(
        &mut self,
        form: &str,
        make: impl FnOnce(&str) -> Result<Vec<f32>, E>,
    ) -> Result<&mut CachedAlternatives, E> {
        let kept = match self.list.iter().position(|(known, _)| known == form) {
            Some(index) => self.list.remove(index),
            None => {
                let shared = CachedAlternatives { things: Arc::new(make(form)?), background: None };
                self.evict_to(MOST_BYTES.saturating_sub(bytes(&shared)));
                (form.to_owned(), shared)
            }
        };
        self.list.push(kept);
        let last = self.list.len() - 1;
        Ok(&mut self.list[last].1)
    }

    fn evict_to(&mut self, most: usize) {
        let mut kept: usize = self.list.iter().map(|(_, shared)| bytes(shared)).sum();
        let outdated = self.list.iter().take_while(|(_, shared)| {
            let evicted = kept > most;
            kept -= if evicted { bytes(shared) } else { 0 };
            evicted
        });
        let outdated = outdated.count();
        self.list.drain(..outdated);
    }
}

fn bytes(shared: &CachedAlternatives) -> usize {
    size_of_val(shared.things.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries_are_made_once_and_bounded() {
        let (mut recent, mut made) = (RecentQueries::default(), 0);
        let mut ask = |text: String| {
            let query = recent.entry((&text, false), |text| {
                made += 1;
                Ok::<_, ()>(TextQuery { text: text.to_owned(), ..TextQuery::default() })
            });
            assert_eq!(query.unwrap().text, text);
            (made, recent.list.len())
        };
        for text in ["cup", "mug", "cup", "mug "] {
            ask(text.to_owned());
        }
        assert_eq!(ask("cup".into()), (3, 3));
        for k in 0..MOST_QUERIES - 1 {
            ask(k.to_string());
        }
        // "mug" and "mug " are evicted, "cup" was asked later.
        assert_eq!(ask("cup".into()), (MOST_QUERIES + 2, MOST_QUERIES));
        assert_eq!(ask("mug".into()), (MOST_QUERIES + 3, MOST_QUERIES));
        assert!(recent.entry(("pen", false), |_| Err(())).is_err());
    }

    #[test]
    fn cache_evicts_least_recent_form() {
        let quarter = MOST_BYTES / 4 / size_of::<f32>();
        let mut cache = AlternativesCache::default();
        let mut made = Vec::new();
        for form in ["", "red", "blue", "", "green", "grey", "", "red", "grey"] {
            let things = cache.entry(form, |form| {
                made.push(form.to_owned());
                Ok::<_, ()>(vec![0.0; quarter])
            });
            assert_eq!(things.unwrap().things.len(), quarter);
            assert!(cache.list.iter().map(|(_, s)| bytes(s)).sum::<usize>() <= MOST_BYTES);
        }
        // The fifth form evicts "red", the least recently used, and "red" later evicts "blue".
        assert_eq!(made, ["", "red", "blue", "green", "grey", "red"]);
        // Larger than the bound: kept alone.
        cache.entry("pink", |_| Ok::<_, ()>(vec![0.0; 5 * quarter])).unwrap();
        assert_eq!(cache.list.len(), 1);
        assert!(cache.entry("brown", |_| Err(())).is_err());
    }
}
