//! What a refusal must be.

/// Longest sentence, bytes: a few names of files and a few words.
const LONGEST: usize = 4000;

/// Refusals are printed for people and into logs: one line, not endless, without what moves a terminal's
/// cursor.
pub fn check(sentence: &str) {
    assert!(!sentence.is_empty(), "a refusal says nothing");
    assert!(
        sentence.len() <= LONGEST,
        "a refusal of {} bytes",
        sentence.len()
    );
    assert!(
        !sentence.contains(char::is_control),
        "a refusal holds a control character: {sentence:?}"
    );
}
