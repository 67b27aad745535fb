"""The words of a prompt as a Grounding DINO model wants them: numbers of word pieces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.detect.preprocess import beside
from cluster_slam.errors import ConfigError, InputError

_SPECIAL = ("[CLS]", "[SEP]", "[PAD]", ".")


@dataclass(frozen=True, slots=True, eq=False)
class Prompt:
    """A text in word pieces."""

    ids: NDArray[np.int64]  # (1, t)
    is_word: NDArray[np.bool_]  # (t,) no mark of begin, end or full stop


def read_prompt(model: Path, text: str) -> Prompt:
    """Word pieces of a prompt, by the vocabulary beside the model (``tokenizer.json`` or ``vocab.txt``).

    Raises
    ------
    ConfigError
        The prompt is empty.
    InputError
        ``tokenizers`` is not installed, or there is no vocabulary.
    """
    try:
        import tokenizers
    except ImportError:
        raise InputError(f"{model}: tokenizers is missing (pip install 'cluster-slam[dino]')") from None
    phrases = [part.strip() for part in text.lower().split(".") if part.strip()]
    if not phrases:
        raise ConfigError(f"prompt {text!r}, expected phrases that end with a full stop, as 'flower .'")
    encoding = _tokenizer(tokenizers, model).encode(" ".join(f"{phrase} ." for phrase in phrases))
    pieces = np.array(encoding.ids, np.int64)
    return Prompt(pieces[None], np.array([piece not in _SPECIAL for piece in encoding.tokens]))


def _tokenizer(tokenizers: Any, model: Path) -> Any:
    whole, vocabulary = beside(model, "tokenizer.json"), beside(model, "vocab.txt")
    if whole is None and vocabulary is None:
        raise InputError(f"{model.parent / 'tokenizer.json'}: missing, expected it or vocab.txt beside the model")
    if whole is not None:
        return tokenizers.Tokenizer.from_file(str(whole))
    lines = vocabulary.read_text("utf-8").splitlines() if vocabulary is not None else []
    words = {word: k for k, word in enumerate(lines)}
    missing = [word for word in ("[UNK]", "[CLS]", "[SEP]") if word not in words]
    if missing:
        raise InputError(f"{vocabulary}: no {missing[0]}, expected BERT's vocabulary")
    made = tokenizers.Tokenizer(tokenizers.models.WordPiece(words, unk_token="[UNK]"))
    made.normalizer = tokenizers.normalizers.BertNormalizer(lowercase=True)
    made.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    made.post_processor = tokenizers.processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", words["[CLS]"]), ("[SEP]", words["[SEP]"])]
    )
    return made
