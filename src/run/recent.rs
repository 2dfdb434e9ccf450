//! What questions have in common, kept within a bound: whoever asks may ask anything.
use crate::query::presence::Background;
use std::sync::Arc;

/// Most bytes of embeddings that are kept: those of texts without a colour and of all with one, 20
/// MB from `words`, and a few more.
const MOST_BYTES: usize = 32 << 20;

/// What texts of one form share.
pub(super) struct SharedOthers {
    /// What they could have said instead: [N, D].
    pub things: Arc<Vec<f32>>,
    /// How well that fits the scene, once it was looked at.
    pub background: Option<Background>,
}

/// By the form of a text (`things::form`); what was asked for least recently goes first.
#[derive(Default)]
pub(super) struct RecentOthers {
    /// The latest last.
    list: Vec<(String, SharedOthers)>,
}

impl RecentOthers {
    /// That of a form, made where it is not kept.
    pub(super) fn of<E>(
        &mut self,
        form: &str,
        make: impl FnOnce(&str) -> Result<Vec<f32>, E>,
    ) -> Result<&mut SharedOthers, E> {
        let kept = match self.list.iter().position(|(known, _)| known == form) {
            Some(at) => self.list.remove(at),
            None => {
                let shared = SharedOthers { things: Arc::new(make(form)?), background: None };
                self.drop_down_to(MOST_BYTES.saturating_sub(bytes(&shared)));
                (form.to_owned(), shared)
            }
        };
        self.list.push(kept);
        let last = self.list.len() - 1;
        Ok(&mut self.list[last].1)
    }

    fn drop_down_to(&mut self, most: usize) {
        let mut kept: usize = self.list.iter().map(|(_, shared)| bytes(shared)).sum();
        let outdated = self.list.iter().take_while(|(_, shared)| {
            let goes = kept > most;
            kept -= if goes { bytes(shared) } else { 0 };
            goes
        });
        let outdated = outdated.count();
        self.list.drain(..outdated);
    }
}

fn bytes(shared: &SharedOthers) -> usize {
    size_of_val(shared.things.as_slice())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forms_are_kept_within_a_bound() {
        let quarter = MOST_BYTES / 4 / size_of::<f32>();
        let mut recent = RecentOthers::default();
        let mut made = Vec::new();
        for form in ["", "red", "blue", "", "green", "grey", "", "red", "grey"] {
            let things = recent.of(form, |form| {
                made.push(form.to_owned());
                Ok::<_, ()>(vec![0.0; quarter])
            });
            assert_eq!(things.unwrap().things.len(), quarter);
            assert!(recent.list.iter().map(|(_, s)| bytes(s)).sum::<usize>() <= MOST_BYTES);
        }
        // The fifth form takes the place of "red", which was asked for least recently, and "red"
        // that of "blue".
        assert_eq!(made, ["", "red", "blue", "green", "grey", "red"]);
        // More than all by itself: answered, and alone.
        recent.of("pink", |_| Ok::<_, ()>(vec![0.0; 5 * quarter])).unwrap();
        assert_eq!(recent.list.len(), 1);
        assert!(recent.of("brown", |_| Err(())).is_err());
    }
}
