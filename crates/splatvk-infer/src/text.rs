//! Sentence embeddings: all-MiniLM-L6-v2 (Reimers & Gurevych 2019; Wang et al. 2020), int8 weights.
use tokenizers::Tokenizer;

use super::registry::{PackFileKind, Registry};
use super::runtime::{Input, Session};
use crate::progress::Progress;
use crate::{Error, Result};

/// Length of an embedding.
pub const DIM: usize = 384;
/// Texts per forward pass: enough to fill the cores, small enough to stay in their caches.
const BATCH: usize = 32;

/// Tokenizer and network.
pub struct TextEncoder {
    session: Session,
    tokenizer: Tokenizer,
}

impl TextEncoder {
    /// Loads both from the model pack.
    pub fn load(registry: &Registry) -> Result<Self> {
        let file = registry.path(PackFileKind::Tokenizer)?;
        let failed =
            |e: tokenizers::Error| Error::missing_model(file.display(), format!("{}: {e}", file.display()));
        let mut tokenizer = Tokenizer::from_file(&file).map_err(failed)?;
        // The file pads every text to 128 tokens, which would only cost time here.
        tokenizer.with_padding(None);
        Ok(TextEncoder { session: registry.session(PackFileKind::Text)?, tokenizer })
    }

    /// Token ids of a text, with its start and end marks; cut at 128.
    pub fn tokens(&self, text: &str) -> Result<Vec<i64>> {
        let encoded =
            self.tokenizer.encode(text, true).map_err(|e| Error::input(format!("text {text:?}: {e}")))?;
        Ok(encoded.get_ids().iter().map(|id| i64::from(*id)).collect())
    }

    /// Whether a word is one token: the tokenizer cuts words that are not English, and rare ones.
    pub fn is_word(&self, word: &str) -> Result<bool> {
        Ok(self.tokens(word)?.len() == 3)
    }

    /// Unit embedding [384] of one text.
    pub fn embed(&mut self, text: &str) -> Result<Vec<f32>> {
        let tokens = self.tokens(text)?;
        self.forward(&[&tokens])
    }

    /// Unit embeddings [N, 384]. The int8 network scales its activations over a whole batch, so an
    /// embedding differs in the third digit from that of [`TextEncoder::embed`]: acceptable for a
    /// fixed list, not for a single query.
    pub fn embed_list(&mut self, texts: &[&str], progress: &dyn Progress) -> Result<Vec<f32>> {
        let tokens = texts.iter().map(|t| self.tokens(t)).collect::<Result<Vec<_>>>()?;
        let mut order: Vec<usize> = (0..texts.len()).collect();
        order.sort_by_key(|&i| tokens[i].len());
        let mut all = vec![0f32; texts.len() * DIM];
        // Only texts of one length share a batch: no padding, no mask.
        for group in order.chunk_by(|&a, &b| tokens[a].len() == tokens[b].len()) {
            for batch in group.chunks(BATCH) {
                progress.check()?;
                let rows: Vec<&Vec<i64>> = batch.iter().map(|&i| &tokens[i]).collect();
                let embedded = self.forward(&rows)?;
                for (&i, row) in batch.iter().zip(embedded.chunks_exact(DIM)) {
                    all[i * DIM..(i + 1) * DIM].copy_from_slice(row);
                }
            }
        }
        Ok(all)
    }

    /// Mean over the tokens of the last layer, normalised. All rows have the same length.
    fn forward(&mut self, rows: &[&Vec<i64>]) -> Result<Vec<f32>> {
        let (n, length) = (rows.len(), rows.first().map_or(0, |r| r.len()));
        let shape = || vec![n, length];
        let ids = rows.iter().flat_map(|r| r.iter().copied()).collect();
        let inputs = vec![
            ("input_ids", Input::I64(shape(), ids)),
            ("attention_mask", Input::I64(shape(), vec![1; n * length])),
            ("token_type_ids", Input::I64(shape(), vec![0; n * length])),
        ];
        let output = self.session.run(inputs, &["last_hidden_state"])?;
        let states = output.first().map(|t| &t.data[..]).unwrap_or_default();
        let mut all = Vec::with_capacity(n * DIM);
        for tokens in states.chunks_exact(length * DIM) {
            let mut sum = vec![0f32; DIM];
            for token in tokens.chunks_exact(DIM) {
                sum.iter_mut().zip(token).for_each(|(s, t)| *s += t);
            }
            normalise(&mut sum);
            all.extend(sum);
        }
        Ok(all)
    }
}

/// Scales to unit length; a zero vector stays zero.
pub(super) fn normalise(v: &mut [f32]) {
    let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    if norm > 0.0 {
        v.iter_mut().for_each(|x| *x /= norm);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encoder() -> TextEncoder {
        TextEncoder::load(&Registry::open(None).unwrap()).unwrap()
    }

    fn cosine(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(p, q)| p * q).sum()
    }

    #[test]
    fn tokens_match_published_vocabulary() {
        let net = encoder();
        // Ids looked up by hand in the uncased BERT vocabulary (line number in vocab.txt less one).
        for (text, ids) in [
            ("", vec![101, 102]),
            ("lemon", vec![101, 14380, 102]),
            ("Blue MUG", vec![101, 2630, 14757, 102]),
            ("box of cereal", vec![101, 3482, 1997, 20943, 102]),
            ("café!", vec![101, 7668, 999, 102]),
        ] {
            assert_eq!(net.tokens(text).unwrap(), ids, "{text:?}");
        }
        assert_eq!(net.tokens(&"lemon ".repeat(500)).unwrap().len(), 128);
    }

    #[test]
    fn embed_relates_similar_words() {
        let mut net = encoder();
        let mut embed = |t: &str| net.embed(t).unwrap();
        let (mug, cup, dog) = (embed("coffee mug"), embed("a cup of coffee"), embed("a dog running"));
        assert!((cosine(&mug, &mug) - 1.0).abs() < 1e-5);
        // The float32 original gives 0.77 and 0.06 to these pairs.
        assert!(cosine(&mug, &cup) > 0.6, "{}", cosine(&mug, &cup));
        assert!(cosine(&mug, &dog) < 0.2, "{}", cosine(&mug, &dog));
    }

    #[test]
    fn embed_list_approximates_embed() {
        let mut net = encoder();
        let texts = ["lemon", "coffee mug", "box of cereal", "plate", "water jug"];
        let list = net.embed_list(&texts, &crate::progress::Silent).unwrap();
        for (text, row) in texts.iter().zip(list.chunks_exact(DIM)) {
            let alone = net.embed(text).unwrap();
            assert!(cosine(row, &alone) > 0.99, "{text}: {}", cosine(row, &alone));
        }
    }
}
