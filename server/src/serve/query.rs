//! Query parameters, read strictly: one that is not known, or stands twice, is refused by its name.

use axum::{extract::Query, http::Uri};

use super::problem::{Problem, repeated};

/// The parameters of a request, each at most once, all of them known.
#[derive(Debug)]
pub struct Parameters(Vec<(String, String)>);

impl Parameters {
    /// Reads the query of `uri`.
    ///
    /// # Errors
    /// A parameter that is not among `known`, or stands more than once.
    pub fn read(uri: &Uri, known: &[&str]) -> Result<Self, Problem> {
        let Query(pairs) = Query::<Vec<(String, String)>>::try_from_uri(uri)
            .map_err(|error| Problem::BadQuery { reason: error.to_string() })?;
        for (index, (name, _)) in pairs.iter().enumerate() {
            if !known.contains(&name.as_str()) {
                let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
                return Err(Problem::UnknownParameter { name: repeated(name), known });
            }
            if pairs[..index].iter().any(|(earlier, _)| earlier == name) {
                return Err(Problem::RepeatedParameter { name: repeated(name) });
            }
        }
        Ok(Self(pairs))
    }

    /// Reads one parameter with `parse`, which says what is wrong with a value; `None` where it is not given.
    ///
    /// # Errors
    /// The parameter's name and value, with the reason that `parse` gives.
    pub fn get<T>(
        &self,
        name: &'static str,
        parse: impl FnOnce(&str) -> Result<T, String>,
    ) -> Result<Option<T>, Problem> {
        let Some((_, value)) = self.0.iter().find(|(given, _)| given == name) else { return Ok(None) };
        parse(value).map(Some).map_err(|reason| Problem::BadParameter { name, value: repeated(value), reason })
    }
}

/// Reads the length of a page; more than `most` counts as that (OGC 17-069r4, requirement 22).
///
/// # Errors
/// Any text but a whole number, 1 or more.
pub fn parse_limit(text: &str, most: usize) -> Result<usize, String> {
    let limit = whole_number(text).filter(|limit| *limit >= 1).ok_or("it must be a whole number, 1 or more")?;
    Ok(usize::try_from(limit).unwrap_or(usize::MAX).min(most))
}

/// Reads a whole number that is not negative; one that is too large to count by counts as the largest.
#[must_use]
pub fn whole_number(text: &str) -> Option<u64> {
    let is_one = !text.is_empty() && text.bytes().all(|digit| digit.is_ascii_digit());
    is_one.then(|| text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(query: &str) -> Result<Parameters, Problem> {
        Parameters::read(&format!("/items?{query}").parse().unwrap(), &["bbox", "limit"])
    }

    #[test]
    fn a_parameter_that_is_not_known_is_refused_by_its_name() {
        let refusal = read("limit=1&bbbox=1").unwrap_err();
        assert_eq!(refusal.to_string(), "parameter \"bbbox\" is not known here; known: bbox, limit");
    }

    #[test]
    fn a_parameter_that_stands_twice_is_refused() {
        assert_eq!(read("limit=1&limit=2").unwrap_err(), Problem::RepeatedParameter { name: "limit".into() });
    }

    #[test]
    fn a_number_beyond_the_most_counts_as_the_most_and_a_text_is_none() {
        assert_eq!(parse_limit("99999999999999999999999", 7), Ok(7));
        assert_eq!(parse_limit("3", 7), Ok(3));
        for text in ["", "0", "-1", "+1", "1.0", "x"] {
            assert!(parse_limit(text, 7).is_err(), "{text}");
        }
    }

    #[test]
    fn a_value_that_cannot_be_read_is_refused_with_the_reason() {
        let refusal = read("limit=x").unwrap().get("limit", |_| Err::<u32, _>("no number".into())).unwrap_err();
        assert_eq!(refusal.to_string(), "parameter \"limit\" = \"x\": no number");
    }
}
