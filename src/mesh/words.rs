//! Words of a line of an OBJ file.

/// `N` finite numbers; `form` says what the line is to look like.
pub(super) fn numbers<'a, const N: usize>(
    words: &mut impl Iterator<Item = &'a [u8]>,
    form: &str,
) -> Result<[f64; N], String> {
    let mut values = [0.0f64; N];
    for (i, value) in values.iter_mut().enumerate() {
        let word = words.next().ok_or_else(|| format!("{form}, this one has {i}; is the file cut off?"))?;
        let text = shown(word);
        *value = text.parse().map_err(|_| format!("`{text}` is not a number; {form}"))?;
        if !(*value as f32).is_finite() {
            return Err(format!("`{text}` is not a finite number; {form}"));
        }
    }
    Ok(values)
}

/// At most 40 bytes of a word, for a message.
pub(super) fn shown(word: &[u8]) -> std::borrow::Cow<'_, str> {
    String::from_utf8_lossy(&word[..word.len().min(40)])
}
